"""Records that the crate wrote (`src/supervise/shard.rs`): shards of a folder, and batches drawn from them by number."""

import json
import threading
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open

from .model import Batch

VERSION = 3


class Shard:
    """One file of records, in memory."""

    def __init__(self, path, settings):
        with safe_open(path, framework="numpy") as file:
            about = json.loads((file.metadata() or {}).get("sdim_records", "{}"))
            if about.get("version") != VERSION:
                raise ValueError(f"{path}: not records of version {VERSION}")
            # The scale of the confidence was found for one set of weights; records know nothing of it.
            if about["settings"] != {k: v for k, v in settings.items() if k != "confidence"}:
                raise ValueError(f"{path}: its settings are not those of the checkpoint's sdim.json")
            tensors = {name: file.get_tensor(name) for name in file.keys()}
        self.config = about["config"]
        self.rgb = torch.from_numpy(tensors.pop("rgb"))
        self.frames, self.height, self.width = self.rgb.shape[:3]
        self.tensors, self.variants = tensors, tensors["told_count"].shape[1]
        self.bytes = self.rgb.nbytes + sum(t.nbytes for t in tensors.values())
        # Shards of one kind can stand in one batch.
        self.kind = (self.height, self.width, *tensors["told_id"].shape[1:], tensors["asked_id"].shape[-1])

    def variant(self, frame, variant):
        """The arrays of one variant by name."""
        at = frame * self.variants + variant
        begin, end = self.tensors["measured_start"][at : at + 2]
        out = {k: v[frame, variant] for k, v in self.tensors.items() if v.shape[:2] == (self.frames, self.variants)}
        return out | {k: self.tensors[k][begin:end] for k in ("measured_pixel", "measured_value")}


def assemble(samples, pin=False):
    """A batch on the CPU from (shard, frame, variant, mirrored)."""
    parts = [shard.variant(frame, variant) for shard, frame, variant, _ in samples]
    shard, mirrored = samples[0][0], np.array([m for *_, m in samples])
    stack = {k: np.stack([p[k] for p in parts]) for k in parts[0] if not k.startswith("measured")}

    def at(name):
        x, y = (stack[f"{name}_{axis}"].astype(np.float32) for axis in "xy")
        return np.stack([np.where(mirrored[:, None], shard.width - 1 - x, x), y], -1)

    depth = np.zeros((len(samples), shard.height * shard.width), np.float32)
    for row, part in zip(depth, parts):
        row[part["measured_pixel"]] = part["measured_value"]
    depth = depth.reshape(-1, shard.height, shard.width)
    depth[mirrored] = depth[mirrored][..., ::-1]
    cells = stack["interpolated"].copy()
    cells[mirrored] = cells[mirrored][..., ::-1]
    batch = dict(depth=depth, interpolated=cells, told_at=at("told"), asked_at=at("asked"), hint=stack["asked_hint"])
    batch |= {k: stack[k].astype(np.int64) for k in ("told_id", "told_count", "asked_id")}
    batch |= dict(value=stack["asked_value"], scale=stack["scale"])
    batch = {k: torch.from_numpy(v) for k, v in batch.items()}
    batch["rgb"] = torch.stack([s.rgb[frame].flip(1) if m else s.rgb[frame] for s, frame, _, m in samples])
    return Batch(**{k: v.pin_memory() if pin else v for k, v in batch.items()})


def on_device(batch, device):
    return Batch(*(t.to(device, non_blocking=True) for t in batch))


class Pool:
    """Shards of a folder, which may grow while they are read. Rank r of w takes every w-th shard from the r-th on."""

    def __init__(self, folder, settings, rank=0, world=1, max_bytes=float("inf")):
        self.folder, self.settings, self.share, self.max_bytes = Path(folder), settings, (rank, world), max_bytes
        self.shards, self.known, self.bytes, self.full = [], set(), 0, False
        self.lock = threading.Lock()

    def refresh(self):
        """Reads shards that are new; returns the number of frames there are."""
        rank, world = self.share
        for path in sorted(self.folder.glob("[0-9]*.safetensors")):
            if path.name in self.known or int(path.stem) % world != rank:
                continue
            if self.bytes >= self.max_bytes:
                self.full = True
                break
            shard = Shard(path, self.settings)
            with self.lock:
                self.known.add(path.name)
                self.shards.append(shard)
                self.bytes += shard.bytes
        return self.frames()

    def frames(self, shards=None):
        return sum(s.frames for s in (self.shards if shards is None else shards))

    def draw(self, seed, step, size):
        """What batch number `step` holds: it depends on the shards that are there, and on nothing else. Frames of one kind,
        each at most once if there are enough, a variant of each, half of them mirrored."""
        with self.lock:
            shards = list(self.shards)
        random = np.random.Generator(np.random.PCG64([seed, step, self.share[0]]))
        one = shards[np.searchsorted(np.cumsum([s.frames for s in shards]), random.integers(self.frames(shards)), "right")]
        shards = [s for s in shards if s.kind == one.kind]
        ends = np.cumsum([s.frames for s in shards])
        chosen = random.choice(ends[-1], size, replace=size > ends[-1], shuffle=False)
        samples = []
        for number, mirrored in zip(chosen, random.random(size) < 0.5):
            i = np.searchsorted(ends, number, "right")
            frame = number - ends[i] + shards[i].frames
            samples.append((shards[i], frame, random.integers(shards[i].variants), mirrored))
        return samples

    def batches(self, seed, first, size, device, follow=False, ahead=6, workers=3):
        """Batches from number `first` on, assembled in threads; `follow` looks for new shards now and then."""
        threads, waiting, step, look = ThreadPoolExecutor(workers), deque(), first, None

        def made(number):
            return assemble(self.draw(seed, number, size), device.type == "cuda")

        try:
            while True:
                if follow and step % 50 == 0 and (look is None or look.done()):
                    if look:
                        look.result()  # Errors of the last look.
                    look = threads.submit(self.refresh)
                while len(waiting) < ahead:
                    waiting.append(threads.submit(made, step))
                    step += 1
                yield on_device(waiting.popleft().result(), device)
        finally:
            threads.shutdown(wait=False, cancel_futures=True)


def held_out(folder, settings, size, device, most=float("inf")):
    """Batches of all records of a folder, the first variant of each frame, in their order."""
    pool = Pool(folder, settings)
    pool.refresh()
    if not pool.shards:
        raise ValueError(f"{folder}: no records")
    samples = [(s, i, 0, False) for s in pool.shards for i in range(s.frames)]
    samples = samples[: int(min(most, len(samples)))]
    while samples:
        group = [x for x in samples[:size] if x[0].kind == samples[0][0].kind]
        samples = samples[len(group) :]
        yield on_device(assemble(group), device)
