"""The model, the loss and the answers are those of the crate: `tests/records.rs` compares it with the same file."""

import torch
from make_fixture import FIXTURE, computed
from safetensors.torch import load_file


def test_logits_answers_and_loss_are_those_of_the_fixture():
    expected, found = load_file(FIXTURE / "expected.safetensors"), computed()
    assert found["logits"].std() > 0.5, "logits that say nothing"
    for name, tolerance in (("logits", 1e-3), ("median", 1e-4), ("loss", 1e-4), ("l1", 1e-4)):
        torch.testing.assert_close(found[name], expected[name], rtol=0, atol=tolerance, msg=name)
