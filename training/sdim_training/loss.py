"""The loss of `src/supervise/loss.rs`, its schedule of `trainer.rs`, and how an answer is read."""

import torch


def blur(progress):
    """Blur of the targets and what is added per unit of depth: wide at first, so that near misses teach."""
    widen = 1 + 7 * max(0.0, 1 - 4 * progress)
    return 0.0015 * widen, 0.008 * widen


def bin_loss(logits, batch, config, blur, slope, l1_weight, entropy_weight=1.0):
    """Cross-entropy with a blurred target plus L1 on the expected number, counted in the frame's scale; mean over questions.
    Returns the loss and the L1."""
    middles, scale = config.middles(logits.device), batch.scale[:, None, None]
    place = config.position(batch.value).clamp(0.5, config.bins - 0.5)[..., None]
    target = config.number(place)
    # Bins of equal ratio are blurred alike near and far.
    sigma = torch.full_like(place, blur + slope) if config.ratio else blur * scale + slope * target
    sigma = (sigma / config.width).clamp(min=0.5)
    blurred = (-0.5 * ((middles - place) / sigma) ** 2).softmax(-1)
    log_p = logits.log_softmax(-1)
    cross_entropy = -(blurred * log_p).sum(-1).mean()
    expected = (log_p.exp() * config.number(middles)).sum(-1, keepdim=True)
    l1 = ((expected - target).abs() / scale).mean()
    return entropy_weight * cross_entropy + l1_weight * l1, l1.detach()


def median(logits, config):
    """The number below which half of the probability lies, linear within its bin."""
    cumulative = logits.double().softmax(-1).cumsum(-1)
    k = (cumulative < 0.5).sum(-1, keepdim=True).clamp(max=config.bins - 1)
    high = cumulative.gather(-1, k)
    low = torch.where(k > 0, cumulative.gather(-1, (k - 1).clamp(min=0)), 0.0)
    inside = ((0.5 - low) / (high - low).clamp(min=1e-12)).clamp(0, 1)
    return config.number(k + inside).squeeze(-1).float()
