"""How much memory a step takes, told from shapes before anything is loaded, and how much there is."""

import os
import resource
from pathlib import Path

import torch

# Values of the width of a layer that its backward pass holds per token, beside those of its MLP: norms in f32 and in the layer's type,
# queries, keys and values before and after their turn, sums, and the gradients of some of them at a time.
PER_WIDTH, PER_INNER = 26, 6
# f32 maps per channel that a convolution with its normalisation and activation keeps.
MAPS = 4


def bytes_of(tensors):
    return sum(t.numel() * t.element_size() for t in tensors)


def step(model, batch, world=1):
    """Bytes by part of one rank's training step with gradient checkpointing, `model` perhaps on the device `meta`. Sharded over
    `world` ranks are the base and its LoRA; layers are gathered one or two at a time."""
    base, own = list(model.base.parameters()), list(model.sdim.parameters())
    trained = [p for p in base if p.requires_grad]
    layers = [list(layer.parameters()) for layer in model.layers()]
    parts = {"weights": bytes_of(base) // world + bytes_of(own)}
    if world > 1:
        inner = {id(p) for layer in layers for p in layer}
        outer = [p for p in base if id(p) not in inner]
        parts["gathered layers"] = 2 * max(map(bytes_of, layers)) + bytes_of(outer) * (world - 1) // world
    parts["gradients"] = bytes_of(trained) // world + bytes_of(own)
    parts["optimiser"] = 2 * (4 * sum(p.numel() for p in trained) // world + 4 * sum(p.numel() for p in own))
    return parts | {"activations": activations(model, batch)}


def activations(model, batch):
    """What is kept for the backward pass, and the largest single layer that is computed again in it."""
    text, vision, size = model.base.config.text_config, model.base.config.vision_config, model.compute.itemsize
    tokens = batch.ids.numel()
    pixels = sum(rgb.shape[0] * rgb.shape[1] for rgb in batch.rgb)
    patches = pixels // vision.patch_size**2
    kept = size * (text.num_hidden_layers * tokens * text.hidden_size + vision.depth * patches * vision.hidden_size)
    # Rows of pixels and what becomes of them; the mask, as bits and as numbers; the answers' rows.
    kept += 3 * pixels * 3 * vision.temporal_patch_size * 4 * 2 + tokens * batch.ids.shape[1] * (1 + size)
    kept += 4 * len(batch.predict) * len(model.numbers) * 4 + 4 * tokens * text.hidden_size * size

    def layer(rows, config):
        return rows * size * (PER_WIDTH * config.hidden_size + PER_INNER * config.intermediate_size)

    largest = [layer(tokens, text), layer(patches, vision)]
    if "fusion" in model.sdim:
        fusion = model.settings["fusion"]
        largest.append(pixels * 4 * (MAPS * (2 * fusion["branch"] + fusion["high"] + fusion["low"]) + 8))
    return kept + max(largest)


def of_process():
    """Bytes that the process has now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def peak(device):
    """The most bytes that there were at a time: on a GPU of tensors, else of the whole process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def available(device):
    """Bytes that a step could take."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
    return int(lines["MemAvailable"].split()[0]) * 1024 + of_process()


def words(parts):
    total = sum(parts.values())
    return f"{total / 1e9:.2f} GB: " + ", ".join(f"{name} {value / 1e9:.2f}" for name, value in parts.items())
