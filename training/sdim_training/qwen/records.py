"""Whole prompts that the crate wrote (`src/supervise/prompts.rs`): shards of folders, streamed in an order that a seed decides.

Words, token ids, positions and labels all come from the crate; nothing is tokenised here.
"""

import json
from collections import OrderedDict, deque
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor

VERSION = 1
# Columns of a token's place: time, row and column of M-RoPE, then the pixel of its crop (NaN: none).
POSITION, PIXEL = slice(0, 3), slice(3, 5)


class Batch(NamedTuple):
    """`b` frames, each with its prompt and all of its questions in `n` tokens, those of shorter ones padded. Numbers are in
    number units."""

    rgb: list  # of u8 [h, w, 3]
    depth: list  # of f32 [h, w]: what the fusion block sees of measurements at their pixels, 0 elsewhere
    ids: Tensor  # i64 [b, n]
    places: Tensor  # f32 [b, n, 5]
    group: Tensor  # i64 [b, n]: 0 in the prompt, k in the k-th question, -1 in the padding
    predict: Tensor  # i64 [s, 2]: frame and token of what predicts a supervised token
    answer: Tensor  # i64 [s]: which number row is right
    question: Tensor  # i64 [s]: whose answer it is, of all questions of the batch
    frame: Tensor  # i64 [q]: of which frame a question is
    value: Tensor  # f32 [q]: the true answers
    hint: Tensor  # f32 [q]
    scale: Tensor  # f32 [q]: what errors are counted in

    def to(self, device):
        def move(part):
            return [t.to(device) for t in part] if isinstance(part, list) else part.to(device, non_blocking=True)

        return Batch(*map(move, self))


class Shard:
    """One file of prompts. Opening reads its metadata, tensors are read when a frame is asked for."""

    def __init__(self, path):
        self.path = Path(path)
        with safe_open(path, framework="numpy") as file:
            about = json.loads((file.metadata() or {}).get("sdim_prompts", "{}"))
            if about.get("version") != VERSION:
                raise ValueError(f"{path}: not prompts of version {VERSION} (`records --base` writes them)")
            self.frames, self.variants, self.questions = (
                file.get_slice(name).get_shape()[axis] for name, axis in (("rgb", 0), ("unit", 1), ("asked_value", 2))
            )
        self.about, self.settings, self.names = about, about["settings"], about["frames"]
        self.tensors = None

    def load(self):
        if self.tensors is None:
            with safe_open(self.path, framework="numpy") as file:
                self.tensors = {name: file.get_tensor(name) for name in file.keys()}
        return self

    def example(self, frame, variant):
        """The arrays of one frame's variant by name, its questions joined."""
        t = self.load().tensors
        at, q = frame * self.variants + variant, self.questions

        def cut(start, first, last, *names):
            begin, end = t[start][first], t[start][last]
            return [t[name][begin:end] for name in names]

        pixels, seen = cut("measured_start", at, at + 1, "measured_pixel", "measured_value")
        prompt_ids, prompt_places = cut("prefix_start", at, at + 1, "prefix_id", "prefix_place")
        asked_ids, asked_places = cut("asked_start", at * q, (at + 1) * q, "asked_id", "asked_place")
        (answers,) = cut("answer_start", at * q, (at + 1) * q, "answer")
        lengths = np.diff(t["asked_start"][at * q : (at + 1) * q + 1].astype(np.int64))
        supervised = np.diff(t["answer_start"][at * q : (at + 1) * q + 1].astype(np.int64))
        ends = len(prompt_ids) + lengths.cumsum()
        depth = np.zeros(self.size, np.float32)
        depth.reshape(-1)[pixels] = seen
        return dict(
            rgb=t["rgb"][frame],
            depth=depth,
            ids=np.concatenate([prompt_ids, asked_ids]).astype(np.int64),
            places=np.concatenate([prompt_places, asked_places]),
            group=np.repeat(np.arange(q + 1), [len(prompt_ids), *lengths]),
            predict=np.concatenate([np.arange(end - n, end) for end, n in zip(ends, supervised)]),
            answer=answers.astype(np.int64),
            question=np.repeat(np.arange(q), supervised),
            value=t["asked_value"][frame, variant],
            hint=t["asked_hint"][frame, variant],
            scale=np.full(q, t["scale"][frame, variant], np.float32),
        )

    @property
    def size(self):
        return self.load().tensors["rgb"].shape[1:3]


def collate(examples):
    """A batch of what [`Shard.example`] gave."""
    n, questions = max(len(e["ids"]) for e in examples), 0
    padded = {"ids": 0, "places": np.nan, "group": -1}
    parts = {k: [] for k in ("ids", "places", "group", "predict", "answer", "question", "frame", "value", "hint", "scale")}
    for row, e in enumerate(examples):
        for name, filler in padded.items():
            room = [(0, n - len(e[name]))] + [(0, 0)] * (e[name].ndim - 1)
            parts[name].append(np.pad(e[name], room, constant_values=filler))
        parts["predict"].append(np.stack([np.full_like(e["predict"], row), e["predict"]], -1))
        parts["question"].append(e["question"] + questions)
        parts["frame"].append(np.full(len(e["value"]), row))
        for name in ("answer", "value", "hint", "scale"):
            parts[name].append(e[name])
        questions += len(e["value"])
    joined = {k: torch.from_numpy((np.stack if k in padded else np.concatenate)(v)) for k, v in parts.items()}
    joined["places"][..., POSITION].nan_to_num_(0.0)
    return Batch(*([torch.from_numpy(e[k]) for e in examples] for k in ("rgb", "depth")), **joined)


class Stream:
    """Batches by number from the shards of some folders, a few shards in memory at a time.

    An epoch takes the shards in a random order, `window` of them at a time, and the frames of a window in a random order; the
    variants of a frame take turns from epoch to epoch. What a batch holds depends on the seed, its number and the shards alone, so
    that a run goes on where it was; rank r of w takes every w-th frame of it from the r-th on.
    """

    def __init__(self, folders, seed=0, rank=0, world=1, window=4):
        self.shards = [Shard(path) for folder in folders for path in sorted(Path(folder).glob("[0-9]*.safetensors"))]
        if not self.shards:
            raise ValueError(f"{', '.join(map(str, folders))}: no shard of prompts")
        first = self.shards[0]
        for shard in self.shards:
            for key in ("settings", "numbers", "image"):
                if shard.about[key] != first.about[key]:
                    raise ValueError(f"{shard.path}: another `{key}` than {first.path}")
        self.about, self.settings = first.about, first.settings
        self.seed, self.rank, self.world, self.window = seed, rank, world, window
        self.frames = sum(s.frames for s in self.shards)
        self.recent, self.order = OrderedDict(), (None, None)

    def epoch(self, number):
        """(shard, frame, variant) in the order of an epoch."""
        if self.order[0] != number:
            random, order = np.random.Generator(np.random.PCG64([self.seed, number])), []
            shards = random.permutation(len(self.shards))
            for start in range(0, len(shards), self.window):
                some = [(s, f) for s in shards[start : start + self.window] for f in range(self.shards[s].frames)]
                order += [some[i] for i in random.permutation(len(some))]
            self.order = number, [(s, f, number % self.shards[s].variants) for s, f in order]
        return self.order[1]

    def samples(self, step, size):
        """What this rank's part of batch number `step` holds; `size` frames per rank."""
        whole = size * self.world
        first = step * whole + self.rank
        places = (divmod(i, self.frames) for i in range(first, first + whole, self.world))
        return [self.epoch(epoch)[i] for epoch, i in places]

    def batch(self, step, size):
        examples = []
        for s, frame, variant in self.samples(step, size):
            examples.append(self.shards[s].example(frame, variant))
            self.recent[s] = None
            self.recent.move_to_end(s)
        while len(self.recent) > 2 * self.window:
            self.shards[self.recent.popitem(last=False)[0]].tensors = None
        return collate(examples)

    def batches(self, first, size, ahead=2):
        """Batches from number `first` on, read in a thread."""
        with ThreadPoolExecutor(1) as thread:
            waiting, step = deque(), first
            while True:
                while len(waiting) < ahead:
                    waiting.append(thread.submit(self.batch, step, size))
                    step += 1
                yield waiting.popleft().result()


def held_out(folders, size, most):
    """Batches of the first variants of the frames of some folders, in their order."""
    stream, batches, examples = Stream(folders), [], []
    for shard in stream.shards:
        for frame in range(min(shard.frames, most - len(batches) * size - len(examples))):
            examples.append(shard.example(frame, 0))
            if len(examples) == size:
                batches.append(collate(examples))
                examples = []
        shard.tensors = None
    return batches + ([collate(examples)] if examples else [])
