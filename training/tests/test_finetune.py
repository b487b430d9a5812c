"""Fine-tuning of real-size models: what PyTorch answers is what `tests/finetune.rs` compares the crate with; streams, resuming, memory."""

import json
import os
import subprocess
import sys

import pytest
import torch
from safetensors.torch import load_file

pytest.importorskip("transformers")
pytest.importorskip("peft")

import make_finetune as make  # noqa: E402
from sdim_training.qwen import adapter, memory, shapes, train  # noqa: E402
from sdim_training.qwen.loss import NumberLoss  # noqa: E402
from sdim_training.qwen.records import Batch, Shard, Stream, collate  # noqa: E402

NAMES = list(make.QUESTIONS)


@pytest.fixture(scope="module")
def bases(tmp_path_factory):
    folders = {name: tmp_path_factory.mktemp(f"base_{name}") for name in NAMES}
    return {name: make.make_base(folder, tied=name == "paper") for name, folder in folders.items()}


@pytest.fixture
def start(tmp_path):
    def made(name):
        folder = tmp_path / f"start_{name}"
        folder.mkdir(exist_ok=True)
        (folder / "sdim.json").write_text(json.dumps(make.settings(name)))
        return folder

    return made


def largest(a, b):
    return (a - b).abs().max().item()


@pytest.mark.parametrize("name", NAMES)
def test_the_adapter_answers_as_the_fixture_says(name, bases):
    expected = load_file(make.FIXTURE / name / "expected.safetensors")["first_logits"]
    found = make.first_logits(make.loaded(name, bases[name], make.FIXTURE / name), name)
    assert expected.std() > 0.3 and largest(found, expected) < 1e-4


@pytest.mark.parametrize("name", NAMES)
def test_tuning_again_gives_the_adapter_again(name, bases, start, tmp_path):
    trainer = make.tuned(name, bases[name], start(name), make.FIXTURE / name, tmp_path / "out")
    assert trainer.step == make.STEPS
    expected = load_file(make.FIXTURE / name / "expected.safetensors")["first_logits"]
    found = make.first_logits(make.loaded(name, bases[name], tmp_path / "out"), name)
    # Twenty steps carry differences of instruction sets along.
    assert largest(found, expected) < 2e-2
    assert json.loads((tmp_path / "out/sdim.json").read_text()) == make.settings(name)


def test_a_resumed_run_is_that_of_one_go(bases, start, tmp_path):
    def run(out, *more):
        return make.tuned("rows", bases["rows"], start("rows"), make.FIXTURE / "rows", tmp_path / out, *more)

    run("whole")
    run("parts", "--stop-at", 7)
    trainer = run("parts", "--resume")
    assert trainer.step == make.STEPS
    whole, parts = (load_file(tmp_path / out / adapter.TENSORS) for out in ("whole", "parts"))
    assert whole.keys() == parts.keys() and all(torch.equal(whole[k], parts[k]) for k in whole)
    with pytest.raises(SystemExit, match="rate"):
        run("parts", "--resume", "--rate", 1e-3)


def test_questions_do_not_see_each_other(bases):
    model, shard = make.loaded("paper", bases["paper"], make.FIXTURE / "paper"), Shard(make.FIXTURE / "paper/000000.safetensors")
    example, q = shard.example(0, 0), shard.questions
    with torch.no_grad():
        together, _ = model(collate([example, shard.example(1, 0)]))
        for k in range(q):
            keep = (example["group"] == 0) | (example["group"] == k + 1)
            mine = example["question"] == k
            alone = example | {name: example[name][keep] for name in ("ids", "places", "group")}
            alone |= dict(predict=keep.cumsum()[example["predict"][mine]] - 1, answer=example["answer"][mine])
            alone |= dict(question=example["question"][mine] * 0, **{n: example[n][k : k + 1] for n in ("value", "hint", "scale")})
            found, _ = model(collate([alone]))
            assert largest(found, together[: len(example["answer"])][torch.from_numpy(mine)]) < 1e-4


def test_a_fresh_adapter_changes_no_word_of_the_base(bases, start):
    """Zero convolutions and LoRA: the tower's tokens are the base's own, bit for bit."""
    about = Shard(make.FIXTURE / "paper/000000.safetensors").about
    chosen = make.options("paper", bases["paper"], start("paper"), make.FIXTURE / "paper", "unused")
    model = train.build(chosen, train.settings_of(chosen), about, "cpu", torch.float32).eval()
    adapter.initial(model, adapter.digit_ids(bases["paper"]), 1)
    batch = collate([Shard(make.FIXTURE / "paper/000000.safetensors").example(0, 0)])
    base = shapes.read_base(bases["paper"], torch.float32).eval()
    with torch.no_grad():
        image = (batch.rgb[0].permute(2, 0, 1) * (1 / 255) - model.mean) / model.std
        tokens, _ = model.encode([image], batch.depth, False)
        grid = torch.tensor([[1, image.shape[1] // model.patch, image.shape[2] // model.patch]])
        assert torch.equal(tokens, base.model.visual(model.patches(image), grid_thw=grid).pooler_output)
        assert batch.depth[0].count_nonzero() > 10


@pytest.mark.parametrize("kind", sorted(train.LOSSES))
def test_losses_of_digits_are_those_of_the_crate(kind):
    """By hand: three digits and the point of 1.250 and 12.500, the answer of the first one wrong by 0.1."""
    answers = [[1, 10, 2, 5, 0], [1, 2, 10, 5, 0, 0]]
    logits = torch.full((11, 11), -30.0)
    said = [[1, 10, 3, 5, 0], answers[1]]
    for row, digit in enumerate(said[0] + said[1]):
        logits[row, digit] = 30.0
    question = torch.tensor([0] * 5 + [1] * 6)
    empty = torch.zeros(0)
    batch = Batch([], [], empty, empty, empty, empty, torch.tensor(sum(answers, [])), question, empty, torch.zeros(2), empty, torch.tensor([2.0, 5.0]))
    weights = train.LOSSES[kind]
    loss, l1 = NumberLoss({"kind": "digits", "decimals": 3}, weights[0], 4.0 * weights[1])(logits, batch, 0.5)
    # In its frame's scale, and the mean of both; one of eleven tokens is wrong by 60.
    assert l1.item() == pytest.approx(0.1 / 2 / 2, rel=1e-4)
    assert loss.item() == pytest.approx(weights[0] * 60 / 11 + weights[1] * 4 * 0.025, rel=1e-3)


def test_ranks_share_an_epoch_and_every_epoch_is_another(tmp_path):
    for i in range(3):
        (tmp_path / f"{i:06}.safetensors").write_bytes((make.FIXTURE / "rows/000000.safetensors").read_bytes())
    whole = Stream([tmp_path], seed=5, window=2)
    epochs = [whole.samples(step, 12) for step in range(2)]
    assert epochs[0] != epochs[1] and all(sorted(e) == sorted(epochs[0]) for e in epochs) and len(set(epochs[0])) == 12
    ranks = [Stream([tmp_path], seed=5, rank=r, world=2, window=2) for r in range(2)]
    assert sorted(ranks[0].samples(0, 6) + ranks[1].samples(0, 6)) == sorted(epochs[0])
    assert not set(ranks[0].samples(0, 6)) & set(ranks[1].samples(0, 6))
    assert whole.samples(1, 12) == epochs[1], "a batch follows from its number"
    # Shards that are no longer needed are let go.
    batches = whole.batches(0, 2)
    for _ in range(18):
        next(batches)
    batches.close()
    assert sum(s.tensors is not None for s in whole.shards) <= 2 * whole.window


@pytest.mark.parametrize("size", sorted(shapes.SIZES))
def test_published_sizes_have_the_published_number_of_parameters(size):
    base = shapes.base(shapes.config(size), torch.bfloat16, "meta")
    expected = {"3b": 3_754_622_976, "7b": 8_292_166_656}[size]
    assert sum(p.numel() for p in base.parameters()) == expected
    # bf16, as the files have it.
    assert memory.bytes_of(base.parameters()) == 2 * expected


def test_what_is_told_of_memory_is_the_sum_of_what_is_there():
    settings = json.loads((train.SETTINGS / "rows.json").read_text())
    chosen = train.options(["--random-shape", "3b", "--layers", "2", "--steps", "1"])
    about = {"numbers": list(range(1000)), "image": 151655}
    model = train.build(chosen, settings, about, "meta", torch.bfloat16)
    batch = shapes.made_up(shapes.config("3b", 2), settings, (224, 168), 8, 4, 1)
    one, eight = memory.step(model, batch), memory.step(model, batch, 8)
    trained = sum(p.numel() for p in model.parameters() if p.requires_grad)
    assert one["gradients"] == 4 * trained and one["optimiser"] == 8 * trained
    own = memory.bytes_of(model.sdim.parameters())
    assert eight["weights"] == memory.bytes_of(model.base.parameters()) // 8 + own
    assert memory.step(model, shapes.made_up(shapes.config("3b", 2), settings, (448, 336), 8, 4, 1))["activations"] > 2 * one["activations"]


def test_two_ranks_tune_as_one_process(bases, start, tmp_path):
    """FSDP on CPUs: the same frames in two halves. Statistics are those of the checkpoint, since each rank would measure its own half."""
    given = ["--freeze-norm-at", "0", "--steps", "4", "--stop-at", "4"]

    def arguments(out, batch):
        launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", 2 // batch]
        chosen = ["--base", bases["rows"], "--adapter", start("rows"), "--records", make.FIXTURE / "rows", "--out", tmp_path / out]
        chosen += ["--batch", batch, "--rate", 1e-2, "--warmup", 1, "--precision", "f32", "--device", "cpu", *given]
        return [str(a) for a in [*launch, "-m", "sdim_training.qwen.train", *chosen]]

    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(make.ROOT / "training")}
    for out, batch in (("one", 2), ("two", 1)):
        subprocess.run(arguments(out, batch), check=True, env=environment, timeout=600)
    one, two = (load_file(tmp_path / out / adapter.TENSORS) for out in ("one", "two"))
    assert one.keys() == two.keys() and max(largest(one[k], two[k]) for k in one) < 1e-3
