"""The loss of `src/supervise/loss.rs` on number rows: cross-entropy, L1 on the expected number, or both."""

import torch

from ..loss import bin_loss, blur, median
from ..model import Bins

# Index of the decimal point among the rows of digits.
POINT = 10


class NumberLoss:
    """`cross_entropy` and `l1` are weights; the paper has the L1 alone."""

    def __init__(self, number, cross_entropy, l1):
        self.weights, self.bins = (cross_entropy, l1), None
        if number["kind"] == "digits":
            self.decimals = number["decimals"]
        else:
            self.bins = Bins(number)

    def __call__(self, logits, batch, progress):
        """Loss and L1, means over the questions."""
        if self.bins is None:
            return self.digits(logits, batch)
        cross_entropy, l1 = self.weights
        # As many frames of one question each: errors are counted in the scale of its own frame.
        single = batch._replace(value=batch.value[:, None])
        return bin_loss(logits[:, None], single, self.bins, *blur(progress), l1, cross_entropy)

    def digits(self, logits, batch):
        """The digits of an answer one after the other, each after the true ones before it. The expected number is the sum of what
        each place is expected to hold."""
        log_p = logits.log_softmax(-1)
        cross_entropy = -log_p.gather(-1, batch.answer[:, None]).mean()
        face = torch.arange(POINT + 1, device=logits.device) % POINT
        off = (log_p.exp() @ face.float() - face[batch.answer]) * self.worth(batch)
        sums = torch.zeros_like(batch.value).index_add(0, batch.question, off)
        l1 = sums.abs().mean()
        return self.weights[0] * cross_entropy + self.weights[1] * l1, l1.detach()

    def worth(self, batch):
        """What 1 at a digit's place is worth in its frame's scale; 0 for the point."""
        count = torch.zeros_like(batch.value, dtype=torch.long).index_add(0, batch.question, torch.ones_like(batch.answer))
        starts = count.cumsum(0) - count
        place = torch.arange(len(batch.answer), device=batch.answer.device) - starts[batch.question]
        point = count[batch.question] - self.decimals - 1
        power = (point - place - (place < point).long()).float()
        return torch.where(batch.answer == POINT, 0.0, 10.0**power) / batch.scale[batch.question]

    def answers(self, logits):
        """One number per question, where numbers are bins; `None` for digits, which have to be chosen one after the other."""
        return None if self.bins is None else median(logits, self.bins)
