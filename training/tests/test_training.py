"""Training on the fixture's records: it learns, resumes bit for bit, survives bad numbers, and publishes what was averaged."""

import csv
import json
import math
import shutil
from types import SimpleNamespace

import pytest
import torch
from make_fixture import FIXTURE
from safetensors.torch import load_file

from sdim_training import checkpoint, train
from sdim_training.records import Pool, assemble

CPU = torch.device("cpu")


def arguments(tmp_path, *more):
    """Records and a checkpoint beside each other, as the crate writes them."""
    records = tmp_path / "records"
    records.mkdir(exist_ok=True)
    shutil.copy(FIXTURE / "000000.safetensors", records)
    chosen = ["--records", records, "--init", FIXTURE / "checkpoint", "--out", tmp_path / "out", "--batch", "2"]
    chosen += ["--steps", "8", "--warmup", "2", "--log-every", "1", "--evaluate-every", "0.5", *more]
    return train.options([str(c) for c in chosen])


def trainer_and_batch(tmp_path, *more):
    trainer = train.Trainer(arguments(tmp_path, *more), CPU)
    pool = Pool(tmp_path / "records", trainer.config.sdim)
    pool.refresh()
    return trainer, pool, assemble(pool.draw(1, 0, 2))


def test_the_loss_falls(tmp_path):
    trainer, _, batch = trainer_and_batch(tmp_path, "--rate", "3e-3")
    losses = [trainer.train_step(batch, 0.5)[0] for _ in range(25)]
    assert losses[-1] < 0.7 * losses[0], losses


def test_a_resumed_run_is_the_run_bit_for_bit(tmp_path):
    def ran(name, *more):
        return train.run(arguments(tmp_path / name, *more), CPU)

    for name in ("whole", "parts"):
        (tmp_path / name).mkdir()
    whole = ran("whole", "--held-out", FIXTURE)
    ran("parts", "--stop-at", "3")
    parts = ran("parts", "--resume", "--held-out", FIXTURE)
    assert whole.step == parts.step == 8
    for old, new in ((whole.model, parts.model), (whole.average, parts.average)):
        for (name, a), b in zip(old.state_dict().items(), new.state_dict().values(), strict=True):
            assert torch.equal(a, b), name
    with open(tmp_path / "whole/out/curve.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert {int(r["step"]) for r in rows} == set(range(9)) and float(rows[-1]["geometric_records"]) > 0
    published = load_file(tmp_path / "whole/out/model.safetensors")
    for name, value in whole.average.state_dict().items():
        assert torch.equal(published[name], value.bfloat16()), name
    assert published.keys() == load_file(FIXTURE / "checkpoint/model.safetensors").keys()
    assert all((tmp_path / "whole/out" / n).read_text() == (FIXTURE / "checkpoint" / n).read_text() for n in checkpoint.FILES)
    with pytest.raises(SystemExit, match="rate 0.0012 there, 0.5 now"):
        ran("parts", "--resume", "--rate", "0.5")


def test_steps_that_are_not_finite_change_nothing(tmp_path):
    trainer, _, batch = trainer_and_batch(tmp_path)
    trainer.train_step(batch, 0.0)
    before = [{k: v.clone() for k, v in m.state_dict().items()} for m in (trainer.model, trainer.average)]
    trainer.train_step(batch._replace(value=batch.value * float("nan")), 0.0)
    trainer.train_step(batch._replace(depth=batch.depth * float("inf")), 0.0)
    assert trainer.skipped == 2 and trainer.step == 3
    for old, model in zip(before, (trainer.model, trainer.average)):
        assert all(torch.equal(v, old[k]) for k, v in model.state_dict().items())
    trainer.train_step(batch, 0.0)
    assert trainer.in_a_row == 0 and not torch.equal(trainer.model.model.norm.weight, before[0]["model.norm.weight"])


def test_a_run_that_leaves_what_is_finite_goes_back_to_its_average_more_slowly(tmp_path):
    trainer, _, batch = trainer_and_batch(tmp_path)
    for _ in range(12):
        trainer.train_step(batch, 0.0)
    rate = trainer.rate(0.3)
    with torch.no_grad():
        trainer.model.model.norm.weight.fill_(float("inf"))
    lost = 0
    while not trainer.returns:
        trainer.train_step(batch, 0.0)
        lost += 1
    assert lost == 7 and trainer.skipped == 7, "as many as make 0.3 of the last ones"
    average = trainer.average.state_dict()
    assert all(torch.equal(v, average[k]) for k, v in trainer.model.state_dict().items())
    _, _, norm = trainer.train_step(batch, 0.0)
    assert math.isfinite(norm) and trainer.in_a_row == 0 and trainer.slow == 0.5
    # The same place of the schedule and of the warm-up, which began anew: half the rate.
    trainer.step = trainer.returned_at + 12
    assert trainer.rate(0.3) == pytest.approx(rate / 2)
    # Single steps that are lost are no reason.
    for i in range(40):
        value = batch.value * float("nan") if i % 5 == 0 else batch.value
        trainer.train_step(batch._replace(value=value), 0.0)
    assert trainer.returns == 1 and trainer.skipped == 15


def test_statistics_are_measured_up_to_half_and_averaged_like_weights(tmp_path):
    trainer, _, batch = trainer_and_batch(tmp_path)
    norm, average = (m.sdim["fusion"].depth.bn for m in (trainer.model, trainer.average))
    start = norm.running_var.clone()
    trainer.train_step(batch, 0.49)
    moved = norm.running_var.clone()
    assert not torch.equal(moved, start)
    torch.testing.assert_close(average.running_var, start + (1 - 2 / 11) * (moved - start))
    trainer.train_step(batch, 0.5)
    assert torch.equal(norm.running_var, moved)


def test_a_mirrored_frame_mirrors_all_of_it(tmp_path):
    _, pool, _ = trainer_and_batch(tmp_path)
    plain, turned = (assemble([(pool.shards[0], 1, 0, m)]) for m in (False, True))
    assert torch.equal(plain.rgb.flip(2), turned.rgb) and torch.equal(plain.depth.flip(2), turned.depth)
    assert torch.equal(plain.interpolated.flip(2), turned.interpolated)
    for name in ("told_at", "asked_at"):
        a, b = getattr(plain, name), getattr(turned, name)
        assert torch.equal(a[..., 0] + b[..., 0], torch.full_like(a[..., 0], 79)) and torch.equal(a[..., 1], b[..., 1])
    # Told measurements lie where the fusion block sees them.
    x, y = turned.told_at[0, : turned.told_count[0]].long().unbind(-1)
    assert (turned.depth[0, y, x] > 0).all()


def test_what_runs_out_is_said_before_it_does(tmp_path, monkeypatch):
    trainer, _, _ = trainer_and_batch(tmp_path)
    assert not dict(checkpoint.shortages(tmp_path, trainer.model, CPU)).get("disk")
    monkeypatch.setattr(checkpoint.shutil, "disk_usage", lambda _: SimpleNamespace(free=2_000_000))
    assert "0.00 GB of disk left" in dict(checkpoint.shortages(tmp_path, trainer.model, CPU))["disk"]


def test_other_records_are_refused(tmp_path):
    trainer, _, _ = trainer_and_batch(tmp_path)
    with pytest.raises(ValueError, match="settings are not those"):
        Pool(tmp_path / "records", trainer.config.sdim | {"glimpse": 8}).refresh()


def test_a_scale_of_the_confidence_stays_with_its_weights(tmp_path):
    trainer, pool, _ = trainer_and_batch(tmp_path)
    scaled = trainer.config.sdim | {"confidence": {"temperature": 0.8, "offset": 0.2}}
    Pool(tmp_path / "records", scaled).refresh()
    files = tmp_path / "scaled"
    shutil.copytree(FIXTURE / "checkpoint", files)
    (files / "sdim.json").write_text(json.dumps(scaled))
    checkpoint.publish(trainer.model, files, tmp_path / "published")
    assert json.loads((tmp_path / "published/sdim.json").read_text()) == trainer.config.sdim
    assert "confidence" in json.loads((files / "sdim.json").read_text())
