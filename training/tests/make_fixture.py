"""Makes what both sides' parity tests compare with: the logits, the loss and the answers of PyTorch in f32.

    records=tests/fixtures/records
    cargo run --release --example records -- --shape $records/shape.json --settings $records/checkpoint/sdim.json \\
        --fresh $records/checkpoint --out $records --count 2 --shard 2 --variants 2 --size 80x48 --points 12,40 \\
        --prompt 16 --questions 12
    PYTHONPATH=training python training/tests/make_fixture.py

The weights are random where fresh ones are zero, so that nothing hides behind a zero.
"""

from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

from sdim_training.loss import bin_loss, blur, median
from sdim_training.model import Config, SdimModel
from sdim_training.records import Shard, assemble

FIXTURE = Path(__file__).parents[2] / "tests/fixtures/records"
# Of the schedule, for the blur of the targets.
PROGRESS, L1 = 0.1, 4.0


def computed():
    """Logits [frames, variants, questions, bins], the answers, and the loss of all questions."""
    config = Config(FIXTURE / "checkpoint")
    model = SdimModel(config)
    model.load_state_dict({k: v.float() for k, v in load_file(FIXTURE / "checkpoint/model.safetensors").items()})
    shard = Shard(FIXTURE / "000000.safetensors", config.sdim)
    batch = assemble([(shard, i, v, False) for i in range(shard.frames) for v in range(shard.variants)])
    with torch.no_grad():
        logits, _ = model(batch)
        loss, l1 = bin_loss(logits, batch, config, *blur(PROGRESS), L1)
    shape = shard.frames, shard.variants
    return dict(
        logits=logits.unflatten(0, shape), median=median(logits, config).unflatten(0, shape), loss=loss[None], l1=l1[None]
    )


def awake(name, tensor, generator):
    noise = torch.randn(tensor.shape, generator=generator)
    if name.endswith("running_var") or "norm" in name or ".bn.weight" in name or "ln_q" in name:
        return 1 + 0.3 * noise.clamp(-2, 2)
    if tensor.dim() == 1:
        return 0.2 * noise
    gain = 0.5 if "embed_tokens" in name else 1.5 / tensor[0].numel() ** 0.5
    return gain * noise


if __name__ == "__main__":
    path = FIXTURE / "checkpoint/model.safetensors"
    random = torch.Generator().manual_seed(5)
    weights = {k: awake(k, v, random).bfloat16() for k, v in sorted(load_file(path).items())}
    save_file(weights, path)
    save_file({k: v.contiguous() for k, v in computed().items()}, FIXTURE / "expected.safetensors")
