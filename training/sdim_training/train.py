"""Trains a small model on records. `python -m sdim_training.train --help`; `torchrun -m sdim_training.train` for several GPUs."""

import argparse
import contextlib
import copy
import json
import math
import os
import signal
import time
from pathlib import Path

import torch
import torch.distributed as dist
from torch.nn.parallel import DistributedDataParallel
from tqdm import tqdm

from . import checkpoint, report
from .loss import bin_loss, blur, median
from .model import Config, SdimModel
from .records import Pool, held_out

# What a resumed run must share with its beginning, since the schedule or the order of the data depends on it.
KEPT = ("seed", "batch", "rate", "warmup", "steps", "weight_decay", "l1", "average", "freeze_norm_at", "sharp")
COUNTED = ("step", "skipped", "spent", "best", "trouble", "slow", "returns", "returned_at")
BN_MOMENTUM = 0.05
# So many steps one after the other that are not finite are no accident.
MOST_SKIPPED = 100
# Weights on their way to where nothing is finite skip more and more steps. When so much of the last steps (weighed by powers of 0.95) was
# skipped, the run goes back to its moving average, which lies before, at half the rate.
TROUBLE = 0.3


def options(arguments=None):
    parser = argparse.ArgumentParser(prog="sdim_training.train", description=__doc__)
    add = parser.add_argument
    add("--records", type=Path, required=True, help="folder of training records")
    add("--init", type=Path, required=True, help="checkpoint to start from (`records --fresh`)")
    add("--out", type=Path, required=True, help="where the checkpoint, its state, curve and samples go")
    add("--held-out", type=Path, nargs="*", default=[], help="folders of held-out records to score on")
    add("--pictures", type=Path, help="folder of held-out records with a grid, for sample pictures")
    add("--steps", type=int, help="end of the schedule in steps")
    add("--seconds", type=float, help="end of the schedule in seconds of training")
    add("--until", type=float, help="end of the run by the clock (seconds since 1970), its last evaluation included")
    add("--batch", type=int, default=64, help="frames per step and GPU")
    add("--rate", type=float, default=1.2e-3, help="peak learning rate")
    add("--warmup", type=int, default=200, help="steps of linear warm-up")
    add("--weight-decay", type=float, default=0.02)
    add("--l1", type=float, default=4.0, help="weight of the L1 against the cross-entropy")
    add("--clip", type=float, default=1.0, help="largest norm of the gradients")
    add("--average", type=float, default=0.998, help="decay of the moving average per step")
    add("--freeze-norm-at", type=float, default=0.5, help="share of the schedule after which statistics are kept")
    add("--sharp", action="store_true", help="narrow targets from the first step: for a run that goes on from trained weights")
    add("--seed", type=int, default=7)
    add("--follow", action="store_true", help="the folder of records still grows (the order of the data depends on it)")
    add("--wait-frames", type=int, default=0, help="frames that must be there before training starts")
    add("--memory-gb", type=float, help="records in memory, at most; 60 %% of what is free without it")
    add("--resume", action="store_true", help="go on from OUT/state.pt")
    add("--stop-at", type=int, help="stop after this step of the schedule, to go on later with --resume")
    add("--log-every", type=int, default=50, help="steps between rows of curve.csv")
    add("--evaluate-every", type=float, default=0.1, help="share of the schedule between evaluations and saves")
    add("--score-frames", type=int, default=256, help="frames of each held-out set, at most")
    add("--device", help="cuda where there is one, else cpu")
    add("--precision", choices=("bf16", "f32"), help="bf16 on a GPU, f32 elsewhere")
    add("--compile", action=argparse.BooleanOptionalAction, help="torch.compile; without it, on a GPU")
    chosen = parser.parse_args(arguments)
    if not (chosen.steps or chosen.seconds or chosen.until):
        parser.error("an end of the schedule: --steps, --seconds or --until")
    return chosen


class Trainer:
    """A run: the model, its moving average, the optimiser, and how far it is."""

    def __init__(self, chosen, device, rank=0, world=1):
        self.chosen, self.device, self.rank, self.world = chosen, device, rank, world
        self.config = Config(chosen.init)
        self.model = SdimModel(self.config)
        checkpoint.load_weights(self.model, chosen.init)
        self.model.to(device)
        self.average = copy.deepcopy(self.model).requires_grad_(False)
        self.norms = self.model.sdim["fusion"].running()
        self.pairs = [list(m.state_dict().values()) for m in (self.average, self.model)]
        # Weight decay pulls at matrices, but not at the embedding.
        groups = {chosen.weight_decay: [], 0.0: []}
        for name, parameter in self.model.named_parameters():
            decays = parameter.dim() >= 2 and "embed_tokens" not in name
            groups[chosen.weight_decay if decays else 0.0].append(parameter)
        groups = [dict(params=p, weight_decay=decay) for decay, p in groups.items()]
        gpu = device.type == "cuda"
        self.optimiser = torch.optim.AdamW(groups, lr=chosen.rate, betas=(0.9, 0.98), eps=1e-8, fused=gpu)
        self.step, self.skipped, self.in_a_row, self.spent, self.best = 0, 0, 0, 0.0, math.inf
        self.trouble, self.slow, self.returns, self.returned_at = 0.0, 1.0, 0, 0
        if chosen.resume:
            self.load()
        self.bf16 = gpu if chosen.precision is None else chosen.precision == "bf16"
        self.compiled = gpu if chosen.compile is None else chosen.compile
        if self.compiled:
            # Block by block: equal blocks share one compiled form, so that each frame size costs seconds instead of a minute.
            torch._dynamo.config.recompile_limit = 64
            for block in (self.model.sdim["fusion"], *self.model.visual.blocks, *self.model.model.layers):
                block.compile(dynamic=False)
        self.net = self.model
        if world > 1:
            self.net = DistributedDataParallel(
                self.model, device_ids=[device.index] if gpu else None, broadcast_buffers=False
            )

    def precision(self):
        return torch.autocast(self.device.type, torch.bfloat16) if self.bf16 else contextlib.nullcontext()

    def loss(self, batch, progress):
        """Loss, L1 and the statistics that the normalisations saw."""
        with self.precision():
            logits, seen = self.net(batch, progress < self.chosen.freeze_norm_at)
        blurred = blur(1.0 if self.chosen.sharp else progress)
        return *bin_loss(logits, batch, self.config, *blurred, self.chosen.l1), seen

    def train_step(self, batch, progress):
        """One step; returns loss, L1 and the gradients' norm. A step whose gradients are not finite changes nothing."""
        rate = self.rate(progress)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        loss, l1, seen = self.loss(batch, progress)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.chosen.clip)
        loss, l1, norm = torch.stack([loss.detach(), l1, norm]).tolist()
        self.step += 1
        # The norm is the same on every GPU, so that all of them skip or none does.
        if math.isfinite(norm):
            self.in_a_row = 0
            self.optimiser.step()
            self.measure(seen)
            self.move_average()
        else:
            self.skipped, self.in_a_row = self.skipped + 1, self.in_a_row + 1
        self.optimiser.zero_grad(set_to_none=True)
        self.trouble = 0.95 * self.trouble + (0.05 if self.in_a_row else 0.0)
        if self.trouble > TROUBLE:
            self.go_back()
        if self.in_a_row >= MOST_SKIPPED:
            raise SystemExit(f"{MOST_SKIPPED} steps without finite gradients up to step {self.step}: a lower --rate")
        return loss, l1, norm

    def go_back(self):
        """To the moving average, without moments, at half the rate, after another warm-up."""
        self.model.load_state_dict(self.average.state_dict())
        self.optimiser.state.clear()
        self.trouble, self.slow, self.returns, self.returned_at = 0.0, self.slow / 2, self.returns + 1, self.step

    def rate(self, progress):
        """Linear warm-up by steps, times a cosine down to a hundredth; halved by each return to the average."""
        warm = min(1.0, (self.step - self.returned_at + 1) / max(1, self.chosen.warmup))
        return self.slow * self.chosen.rate * warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, progress))))

    @torch.no_grad()
    def measure(self, seen):
        """Moves the running statistics towards those that this step saw, on average over the GPUs."""
        if seen and self.world > 1:
            flat = torch.cat(seen)
            dist.all_reduce(flat)
            seen = (flat / self.world).split([len(s) for s in seen])
        if seen:
            torch._foreach_lerp_(self.norms, list(seen), BN_MOMENTUM)

    @torch.no_grad()
    def move_average(self):
        """Early averages would hold on to the random start."""
        keep = min(self.chosen.average, (1 + self.step) / (10 + self.step))
        torch._foreach_lerp_(*self.pairs, 1 - keep)

    @torch.no_grad()
    def answers(self, batch):
        """The average's answers, a thousand questions at a time."""
        with self.precision():
            parts = zip(*(t.split(1024, 1) for t in (batch.asked_id, batch.asked_at)))
            parts = [self.average(batch._replace(asked_id=i, asked_at=at))[0] for i, at in parts]
        return median(torch.cat(parts, 1), self.config)

    def score(self, batches):
        """Mean over frames of mean |error| / mean depth, of the model and of the hints; their ratio, and the geometric mean
        of the frames' own ratios."""
        model, hint = [], []
        for batch in batches:
            known = batch.value.isfinite()
            truth = batch.value.nan_to_num()
            depth = (truth * known).sum(1)
            for errors, values in ((model, self.answers(batch)), (hint, batch.hint)):
                errors.append(((values - truth).abs() * known).sum(1) / depth)
        model, hint = torch.cat(model), torch.cat(hint)
        ratios = (model.clamp(min=1e-9) / hint.clamp(min=1e-9)).log().mean().exp().item()
        model, hint = model.mean().item(), hint.mean().item()
        return {"sdim": model, "linear": hint, "ratio": model / hint, "geometric": ratios}

    def state(self):
        parts = dict(model=self.model, average=self.average, optimiser=self.optimiser)
        parts = {name: part.state_dict() for name, part in parts.items()}
        return parts | {k: getattr(self, k) for k in COUNTED} | {"settings": {k: getattr(self.chosen, k) for k in KEPT}}

    def load(self):
        state = checkpoint.load_state(self.chosen.out, self.device, {k: getattr(self.chosen, k) for k in KEPT})
        for name in ("model", "average", "optimiser"):
            getattr(self, name).load_state_dict(state[name])
        for name in COUNTED:
            # States of before the returns have none of their counts.
            setattr(self, name, state.get(name, getattr(self, name)))


class Schedule:
    """How much of a run is done."""

    def __init__(self, trainer):
        self.trainer, self.stopped, self.start, self.before = trainer, False, time.time(), trainer.spent
        # Seconds that the last evaluation will take.
        self.reserve = 10.0 if trainer.chosen.until else 0.0
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: setattr(self, "stopped", True))

    def seconds(self):
        return self.before + time.time() - self.start

    def look(self):
        """The share that is done, from 0 to 1, and whether to stop before all of it is; the same on all GPUs."""
        c, step, shares = self.trainer.chosen, self.trainer.step, [0.0]
        if c.steps:
            shares.append(step / c.steps)
        if c.seconds:
            shares.append(self.seconds() / c.seconds)
        if c.until:
            shares.append((time.time() - self.start) / max(1e-6, c.until - self.reserve - self.start))
        stop = self.stopped or (c.stop_at is not None and step >= c.stop_at)
        done = torch.tensor([min(1.0, max(shares)), float(stop)], dtype=torch.float64)
        if self.trainer.world > 1:
            dist.broadcast(done, 0)
        return done[0].item(), done[1].item() > 0


class Reporter:
    """Everything that a run writes; the first process alone has one."""

    def __init__(self, trainer, schedule, pool):
        self.trainer, self.schedule, self.pool, self.chosen = trainer, schedule, pool, trainer.chosen
        c, settings, device = trainer.chosen, trainer.config.sdim, trainer.device
        self.held = {f.name: list(held_out(f, settings, 16, device, c.score_frames)) for f in c.held_out}
        self.pictures = list(held_out(c.pictures, settings, 1, device, 6)) if c.pictures else []
        scores = [f"{kind}_{name}" for name in self.held for kind in ("sdim", "linear", "ratio", "geometric")]
        columns = ["step", "seconds", "frames", "loss", "l1", "gradient", "rate", "skipped", *scores]
        self.curve = report.Curve(c.out / "curve.csv", columns, trainer.step)
        self.values, self.said = [], set()
        self.bar = tqdm(total=100, unit="%", disable=None)
        try:
            from torch.utils.tensorboard import SummaryWriter

            self.board = SummaryWriter(c.out / "board")
        except ImportError:
            self.board = None
        self.parameters = sum(p.numel() for p in trainer.model.parameters())
        said = f"{self.parameters / 1e6:.2f} M parameters, {pool.frames()} frames, {trainer.world} x {device}"
        self.say(f"{said}, step {trainer.step}")

    def say(self, text):
        tqdm.write(f"{self.schedule.seconds():7.1f} s  {text}")

    def add(self, values, progress):
        self.values += [values] if all(map(math.isfinite, values)) else []
        self.bar.update(round(100 * progress) - self.bar.n)
        if self.trainer.step % self.chosen.log_every == 0:
            self.row(progress)

    def row(self, progress, **scores):
        t, count = self.trainer, max(1, len(self.values))
        values = {k: sum(v) / count for k, v in zip(("loss", "l1", "gradient"), zip(*self.values))}
        values |= dict(frames=self.pool.frames(), rate=t.rate(progress), skipped=t.skipped, **scores)
        self.values = []
        self.curve.add(step=t.step, seconds=self.schedule.seconds(), **values)
        for name, value in values.items() if self.board else ():
            self.board.add_scalar(name, value, t.step)
        said = ", ".join(f"{k} {v:.4g}" for k, v in values.items() if not k.startswith(("sdim", "linear")))
        self.say(f"step {t.step}: {said}")
        shortages = dict(checkpoint.shortages(self.chosen.out, t.model, t.device))
        again = f"steps were not finite: return {t.returns} to the average, at {t.slow} of the rate"
        shortages |= {f"return {t.returns}": again} if t.returns else {}
        shortages |= {"records": "no room for more records (--memory-gb)"} if self.pool.full else {}
        for what in shortages.keys() - self.said:
            self.said.add(what)
            self.say(f"WARNING: {shortages[what]}")

    def evaluate(self, progress):
        """Scores the average, saves, and keeps the best apart."""
        t, c, begin, scores = self.trainer, self.chosen, time.time(), {}
        for name, batches in self.held.items():
            scores |= {f"{kind}_{name}": value for kind, value in t.score(batches).items()}
        self.row(progress, **scores)
        means = [v for k, v in scores.items() if k.startswith("geometric")]
        if t.step and means and sum(means) / len(means) < t.best:
            t.best = sum(means) / len(means)
            checkpoint.publish(t.average, c.init, c.out / "best")
        t.spent = self.schedule.seconds()
        checkpoint.publish(t.average, c.init, c.out)
        checkpoint.save_state(c.out, **t.state())
        if self.pictures:
            report.samples(c.out / f"samples/{t.step:07}.png", [(b, t.answers(b)) for b in self.pictures])
        report.draw(self.curve.path)
        self.schedule.reserve = max(self.schedule.reserve, 1.5 * (time.time() - begin) + 2)
        return scores

    def finish(self, progress):
        t, gpu = self.trainer, self.trainer.device.type == "cuda"
        result = dict(steps=t.step, seen=t.step * self.chosen.batch * t.world, skipped=t.skipped, returns=t.returns)
        result |= dict(held_out=self.evaluate(progress), seconds=round(self.schedule.seconds(), 1))
        result |= dict(records=self.pool.frames(), parameters=self.parameters, processes=t.world)
        result |= dict(device=torch.cuda.get_device_name() if gpu else "cpu")
        result |= dict(peak_gb=torch.cuda.max_memory_allocated() / 1e9) if gpu else {}
        (self.chosen.out / "result.json").write_text(json.dumps(result, indent=1) + "\n")
        self.bar.close()
        self.say(f"done: {json.dumps(result)}")


def run(chosen, device, rank=0, world=1):
    torch.set_float32_matmul_precision("high")
    chosen.out.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(chosen, device, rank, world)
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / int(os.environ.get("LOCAL_WORLD_SIZE", 1))
    most = chosen.memory_gb * 1e9 if chosen.memory_gb else 0.6 * free
    pool = Pool(chosen.records, trainer.config.sdim, rank, world, most)
    while pool.refresh() < max(1, chosen.wait_frames // world):
        if not chosen.follow:
            raise SystemExit(f"{chosen.records}: {pool.frames()} frames of records for process {rank} of {world}")
        time.sleep(0.5)
    batches = pool.batches(chosen.seed, trainer.step, chosen.batch, device, chosen.follow)
    batch = next(batches)
    for progress in (0.0, 1.0) if trainer.compiled else ():
        # Both forms of the fusion block, before the clock starts.
        trainer.loss(batch, progress)[0].backward()
        trainer.optimiser.zero_grad(set_to_none=True)
    schedule = Schedule(trainer)
    reporter = Reporter(trainer, schedule, pool) if rank == 0 else None
    if reporter and trainer.step == 0:
        reporter.evaluate(0.0)
    progress, stop = schedule.look()
    due = progress + chosen.evaluate_every
    while progress < 1 and not stop:
        values = trainer.train_step(batch, progress)
        progress, stop = schedule.look()
        if reporter:
            reporter.add(values, progress)
            if due <= progress < 1 and not stop:
                due = progress + chosen.evaluate_every
                reporter.evaluate(progress)
        if progress < 1 and not stop:
            batch = next(batches)
    batches.close()
    if reporter:
        reporter.finish(progress)
    return trainer


def launched(run, chosen):
    """Calls `run(chosen, device, rank, world)` as this process of `torchrun`, or of none."""
    world, rank = (int(os.environ.get(k, d)) for k, d in (("WORLD_SIZE", 1), ("RANK", 0)))
    device = torch.device(chosen.device or ("cuda" if torch.cuda.is_available() else "cpu"))
    if device.type == "cuda":
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
        torch.cuda.set_device(device)
    if world > 1:
        dist.init_process_group("cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo")
    try:
        run(chosen, device, rank, world)
    finally:
        if world > 1:
            dist.destroy_process_group()


def main():
    launched(run, options())


if __name__ == "__main__":
    main()
