"""Fine-tunes Qwen2.5-VL on prompts that the crate wrote. `python -m sdim_training.qwen.train --help`; `torchrun -m
sdim_training.qwen.train` for several GPUs and machines."""

import argparse
import contextlib
import json
import math
import os
import time
from pathlib import Path

import torch
import torch._dynamo  # The optimiser loads it: here, so that it is there when memory is counted.
from tqdm import tqdm

from .. import report
from ..train import BN_MOMENTUM, MOST_SKIPPED, Schedule, launched
from . import adapter, memory, parallel, shapes
from .loss import NumberLoss
from .model import QwenSdim
from .records import Stream, held_out

# What a resumed run must share with its beginning.
KEPT = ("seed", "batch", "accumulate", "rate", "own_rate", "warmup", "steps", "full", "loss", "l1", "freeze_norm_at")
LOSSES = {"both": (1.0, 1.0), "cross-entropy": (1.0, 0.0), "l1": (0.0, 1.0)}
SETTINGS = Path(__file__).parent / "settings"
# Share of a step's prediction that may be missing without a warning.
MARGIN = 0.1


def options(arguments=None):
    parser = argparse.ArgumentParser(prog="sdim_training.qwen.train", description=__doc__)
    add = parser.add_argument
    add("--base", type=Path, help="directory of a published checkpoint")
    add("--random-shape", choices=sorted(shapes.SIZES), help="instead of --base and --records: random weights and prompts of this size")
    add("--layers", type=int, help="fewer layers of text, with --random-shape")
    add("--adapter", type=Path, help="adapter to start from: its sdim.json, and its tensors if there are any")
    add("--records", type=Path, nargs="+", default=[], help="folders of prompts (`records --base`)")
    add("--held-out", type=Path, nargs="*", default=[], help="folders of prompts to score on")
    add("--out", type=Path, help="where the adapter, the state and the curve go")
    add("--lora", type=int, metavar="RANK", help="LoRA of this rank; without it, what sdim.json says")
    add("--lora-alpha", type=float, help="twice the rank without it")
    add("--lora-targets", default="q_proj,k_proj,v_proj,o_proj,gate_proj,up_proj,down_proj", help="last parts of layers' names")
    add("--full", action="store_true", help="train all of the base; OUT is a whole checkpoint")
    add("--loss", choices=sorted(LOSSES), default="both", help="the paper's is l1")
    add("--l1", type=float, default=4.0, help="weight of the L1 against the cross-entropy")
    add("--steps", type=int, required=True)
    add("--batch", type=int, default=1, help="frames at a time and GPU")
    add("--accumulate", type=int, default=1, help="batches per step")
    add("--rate", type=float, default=1e-4, help="peak learning rate of the base, or its LoRA")
    add("--own-rate", type=float, default=1e-3, help="peak learning rate of fusion block, number tokens and crops")
    add("--warmup", type=int, default=100, help="steps")
    add("--weight-decay", type=float, default=0.01)
    add("--clip", type=float, default=1.0, help="largest norm of the gradients")
    add("--freeze-norm-at", type=float, default=0.5, help="share of the steps after which the fusion block's statistics are kept")
    add("--seed", type=int, default=7)
    add("--resume", action="store_true", help="go on from OUT/state")
    add("--stop-at", type=int, help="stop after this step, to go on later with --resume")
    add("--log-every", type=int, default=10)
    add("--save-every", type=int, default=500, help="steps between evaluations and saves")
    add("--score-frames", type=int, default=64, help="held-out frames, at most")
    add("--window", type=int, default=4, help="shards whose frames are mixed")
    add("--device", help="cuda where there is one, else cpu")
    add("--precision", choices=("bf16", "f32"), default="bf16", help="in which the base computes and, frozen, is kept")
    add("--size", default="448x336", help="WIDTHxHEIGHT of made-up frames")
    add("--told", type=int, default=128, help="measurements in made-up prompts")
    add("--asked", type=int, default=64, help="questions in made-up prompts")
    add("--any-memory", action="store_true", help="start although memory may not do")
    chosen = parser.parse_args(arguments)
    chosen.seconds = chosen.until = None
    if not chosen.random_shape and not (chosen.base and chosen.records and chosen.adapter and chosen.out):
        parser.error("--base, --adapter, --records and --out; or --random-shape")
    if chosen.random_shape and (chosen.out or chosen.records):
        parser.error("--random-shape tries what a step takes: it reads no --records and writes no --out")
    return chosen


def settings_of(chosen):
    """sdim.json of the run, with the LoRA that was asked for."""
    settings = adapter.read_settings(chosen.adapter) if chosen.adapter else json.loads((SETTINGS / "rows.json").read_text())
    if chosen.full:
        settings["lora"] = None
    elif chosen.lora:
        alpha = chosen.lora_alpha or 2.0 * chosen.lora
        settings["lora"] = {"rank": chosen.lora, "alpha": alpha, "targets": chosen.lora_targets.split(",")}
    return settings


def build(chosen, settings, about, device, dtype):
    """The model with its LoRA; on the device `meta`, one that has shapes alone."""
    if chosen.random_shape:
        base = shapes.base(shapes.config(chosen.random_shape, chosen.layers), dtype, device)
        numbers, mean, std = about["numbers"], shapes.MEAN, shapes.STD
    else:
        mean, std = shapes.image_numbers(chosen.base)
        numbers = about["numbers"]
        if device == "meta":
            base = shapes.base(shapes.config_of(chosen.base), dtype, device)
        else:
            base = shapes.read_base(chosen.base, dtype)
    if chosen.full:
        base.requires_grad_(True)
    else:
        # The factors' first values, the same on every rank.
        torch.manual_seed(chosen.seed)
        adapter.add_lora(base, settings["lora"])
    with torch.device(device):
        return QwenSdim(base, settings, numbers, about["image"], mean, std)


class Trainer:
    """A run: the model, the optimiser, and how far it is."""

    def __init__(self, chosen, settings, about, device, rank=0, world=1):
        self.chosen, self.settings, self.device, self.rank, self.world = chosen, settings, device, rank, world
        self.bf16 = chosen.precision == "bf16"
        # What is trained in bf16 itself would lose small steps.
        self.dtype = torch.bfloat16 if self.bf16 and not chosen.full else torch.float32
        self.model = parallel.in_turns(lambda: self.made(about)) if world > 1 else self.made(about)
        self.loss = NumberLoss(settings["number"], *(w * s for w, s in zip(LOSSES[chosen.loss], (1.0, chosen.l1))))
        base = [p for p in self.model.base.parameters() if p.requires_grad]
        own = list(self.model.sdim.parameters())
        groups = [dict(params=base, peak=chosen.rate), dict(params=own, peak=chosen.own_rate)]
        groups = [g | {"lr": g["peak"]} for g in groups if g["params"]]
        # One by one: parts of tensors and whole ones do not go together.
        self.optimiser = torch.optim.AdamW(groups, betas=(0.9, 0.98), weight_decay=chosen.weight_decay, foreach=world == 1)
        self.parameters = base + own
        self.step, self.updates, self.skipped, self.in_a_row, self.spent = 0, 0, 0, 0, 0.0
        if chosen.resume:
            self.load()

    def made(self, about):
        model = build(self.chosen, self.settings, about, "cpu", self.dtype)
        model.compute = torch.bfloat16 if self.bf16 and (self.world > 1 or not self.chosen.full) else self.dtype
        if self.chosen.adapter and (self.chosen.adapter / adapter.TENSORS).exists():
            adapter.load(model, self.chosen.adapter)
        else:
            digits = shapes.DIGITS if self.chosen.random_shape else adapter.digit_ids(self.chosen.base)
            adapter.initial(model, digits, self.chosen.seed)
        model.checkpoint_gradients()
        model.train()
        if self.world > 1:
            model.sdim.to(self.device)
            return parallel.shard(model, parallel.mesh_of(self.device, self.world)).to(self.device)
        return model.to(self.device)

    def precision(self):
        mixed = self.bf16 and self.model.compute == torch.float32
        return torch.autocast(self.device.type, torch.bfloat16) if mixed else contextlib.nullcontext()

    def train_step(self, batches):
        """One step over `accumulate` batches; returns loss, L1 and the gradients' norm. A step whose gradients are not finite changes
        nothing."""
        progress, total, off, seen = self.step / self.chosen.steps, 0.0, 0.0, []
        for batch in batches:
            with self.precision():
                logits, stats = self.model(batch, progress < self.chosen.freeze_norm_at)
            loss, l1 = self.loss(logits, batch, progress)
            (loss / len(batches)).backward()
            total, off, seen = total + loss.item() / len(batches), off + l1.item() / len(batches), [*seen, stats]
        parallel.average_own(self.model, self.world)
        norm = parallel.clip(self.parameters, self.chosen.clip, self.world)
        for group in self.optimiser.param_groups:
            group["lr"] = group["peak"] * self.rate(progress)
        self.step += 1
        if math.isfinite(norm):
            self.optimiser.step()
            self.updates, self.in_a_row = self.updates + 1, 0
            self.measure(seen)
        else:
            self.skipped, self.in_a_row = self.skipped + 1, self.in_a_row + 1
        self.optimiser.zero_grad(set_to_none=True)
        if self.in_a_row >= MOST_SKIPPED:
            raise SystemExit(f"{MOST_SKIPPED} steps without finite gradients up to step {self.step}: a lower --rate")
        return total, off, norm

    def rate(self, progress):
        """Share of the peak: linear warm-up by steps, times a cosine down to a hundredth."""
        warm = min(1.0, (self.step + 1) / max(1, self.chosen.warmup))
        return warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, progress))))

    @torch.no_grad()
    def measure(self, seen):
        """Moves the fusion block's statistics towards those that this step saw, on average over its batches and the ranks."""
        seen = [torch.stack(s).mean(0) for s in zip(*seen)]
        if seen:
            seen = parallel.mean_over_ranks(seen, self.world)
            torch._foreach_lerp_(self.model.sdim["fusion"].running(), seen, BN_MOMENTUM)

    @torch.no_grad()
    def score(self, batches):
        """Held-out loss and L1; where numbers are bins, also the ratio of mean errors, the model's answers by the hints'."""
        self.model.eval()
        sums = torch.zeros(4)
        for batch in batches:
            batch = batch.to(self.device)
            with self.precision():
                logits, _ = self.model(batch)
            known = batch.value.isfinite()
            answers = self.loss.answers(logits)
            if known.all():
                sums[:2] += torch.stack([t.cpu() for t in self.loss(logits, batch, 1.0)])
            if answers is not None:
                truth = batch.value[known]
                off = [((a[known] - truth).abs() / batch.scale[known]).mean().cpu() for a in (answers, batch.hint)]
                sums[2:] += torch.stack(off)
        self.model.train()
        loss, l1, model, hint = (sums / max(1, len(batches))).tolist()
        return {"held_loss": loss, "held_l1": l1} | ({"ratio": model / hint} if hint else {})

    def named(self):
        return adapter.trained(self.model, plain=False) | (
            {n: p for n, p in self.model.base.named_parameters() if p.requires_grad} if self.chosen.full else {}
        )

    def save(self):
        """The adapter (or the whole checkpoint) and the state; every rank takes part."""
        out, tensors = self.chosen.out, adapter.trained(self.model)
        base = adapter.base_tensors(self.model) if self.chosen.full else None
        if self.rank == 0:
            adapter.save(tensors, self.settings, out)
            if base:
                adapter.save_base(base, self.chosen.base, out)
        counts = {k: getattr(self, k) for k in ("step", "updates", "skipped", "spent")}
        kept = {k: getattr(self.chosen, k) for k in KEPT} | {"lora": self.settings["lora"]}
        parallel.save_state(out, self.named(), self.optimiser, counts | {"settings": kept})

    def load(self):
        counts = parallel.load_state(self.chosen.out, self.named(), self.optimiser)
        now = {k: getattr(self.chosen, k) for k in KEPT} | {"lora": self.settings["lora"]}
        other = [f"{k} {v} there, {now[k]} now" for k, v in counts["settings"].items() if v != now[k]]
        if other:
            raise SystemExit(f"{self.chosen.out}: another run's state: {', '.join(other)}")
        self.step, self.updates, self.skipped, self.spent = (counts[k] for k in ("step", "updates", "skipped", "spent"))


def say_memory(chosen, settings, about, batch, device, world):
    """What a step will take by part and what there is, before anything is loaded; numbers of parameters, of all and of those that are
    trained; and whether it may not do."""
    dtype = torch.float32 if chosen.full or chosen.precision == "f32" else torch.bfloat16
    model = build(chosen, settings, about, "meta", dtype)
    model.compute = torch.float32 if chosen.precision == "f32" else torch.bfloat16
    parts = {} if device.type == "cuda" else {"process": memory.of_process()}
    parts |= memory.step(model, batch, world)
    # Processes of one machine without GPUs share its memory.
    share = 1 if device.type == "cuda" else int(os.environ.get("LOCAL_WORLD_SIZE", 1))
    total, there = sum(parts.values()), memory.available(device) / share
    count = sum(p.numel() for p in model.base.parameters()), sum(p.numel() for p in model.parameters() if p.requires_grad)
    return parts, there, count, total * (1 + MARGIN) > there


class Reporter:
    """What a run says and writes; the first process alone has one."""

    def __init__(self, trainer):
        self.trainer, self.values = trainer, []
        columns = ["step", "seconds", "loss", "l1", "gradient", "rate", "skipped", "held_loss", "held_l1", "ratio", "peak_gb"]
        out = trainer.chosen.out
        if out:
            out.mkdir(parents=True, exist_ok=True)
        self.curve = report.Curve(out / "curve.csv", columns, trainer.step) if out else None
        self.bar = tqdm(total=trainer.chosen.steps, initial=trainer.step, disable=None)

    def add(self, values, seconds, scores=None):
        t = self.trainer
        self.values += [values] if values else []
        self.bar.update(t.step - self.bar.n)
        if scores is None and t.step % t.chosen.log_every:
            return
        means = {k: sum(v) / len(self.values) for k, v in zip(("loss", "l1", "gradient"), zip(*self.values))}
        row = means | (scores or {}) | {"peak_gb": memory.peak(t.device) / 1e9, "skipped": t.skipped}
        row["rate"], self.values = t.optimiser.param_groups[0]["lr"], []
        if self.curve:
            self.curve.add(step=t.step, seconds=seconds, **row)
        tqdm.write(f"{seconds:7.1f} s  step {t.step}: " + ", ".join(f"{k} {v:.4g}" for k, v in row.items()))


def run(chosen, device, rank=0, world=1):
    settings = settings_of(chosen)
    if chosen.random_shape:
        size = tuple(map(int, chosen.size.split("x")))
        config = shapes.config(chosen.random_shape, chosen.layers)
        about = {"numbers": list(range(settings["number"]["bins"])), "image": config.image_token_id}
        made_up = shapes.made_up(config, settings, size, chosen.told, chosen.asked, chosen.batch, chosen.seed)
        batches, first, held = None, made_up, []
    else:
        stream = Stream(chosen.records, chosen.seed, rank, world, chosen.window)
        about = stream.about
        if adapter.asking(stream.settings) != adapter.asking(settings):
            raise SystemExit(f"{chosen.adapter}: its sdim.json asks in another way than the records")
        first = stream.batch(0, chosen.batch)
        held = held_out(chosen.held_out, chosen.batch, chosen.score_frames) if chosen.held_out else []
    parts, there, (count, trained), tight = say_memory(chosen, settings, about, first, device, world)
    if rank == 0:
        print(f"{count / 1e9:.3f} B parameters, {trained / 1e6:.2f} M of them trained, {world} x {device}, {first.ids.shape[1]} tokens")
        print(f"a step takes about {memory.words(parts)}; there are {there / 1e9:.2f} GB", flush=True)
    if tight and not chosen.any_memory:
        raise SystemExit("that may not do: a smaller --batch, fewer questions, more GPUs, or --any-memory")
    trainer = Trainer(chosen, settings, about, device, rank, world)
    if not chosen.random_shape:
        batches = stream.batches(trainer.step * chosen.accumulate, chosen.batch)
    schedule = Schedule(trainer)
    reporter = Reporter(trainer) if rank == 0 else None
    progress, stop = schedule.look()
    while progress < 1 and not stop:
        some = [(next(batches) if batches else first).to(device) for _ in range(chosen.accumulate)]
        values = trainer.train_step(some)
        progress, stop = schedule.look()
        due = stop or progress >= 1 or trainer.step % chosen.save_every == 0
        scores = trainer.score(held) if due and held else None
        if reporter:
            reporter.add(values, schedule.seconds(), scores or ({} if due else None))
        if due and chosen.out:
            trainer.spent = schedule.seconds()
            trainer.save()
    if batches:
        batches.close()
    if reporter:
        peak, total = memory.peak(device), sum(parts.values())
        print(f"peak {peak / 1e9:.2f} GB, {peak / total - 1:+.1%} of what was told")
        seconds = schedule.seconds() - schedule.before
        print(f"{seconds / max(1, trainer.step):.2f} s a step")
    return trainer


def main():
    launched(run, options())


if __name__ == "__main__":
    main()
