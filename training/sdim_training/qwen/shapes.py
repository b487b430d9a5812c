"""Published sizes with random weights, and prompts that are made up: what a step takes can be tried without checkpoint and records."""

import json
from pathlib import Path

import numpy as np
import torch
from transformers import AutoConfig, Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration

from .model import FIRST_ADDED
from .records import collate

# Of the published config.json: what differs between the sizes.
SIZES = {
    "3b": dict(
        hidden_size=2048, num_hidden_layers=36, num_attention_heads=16, num_key_value_heads=2, intermediate_size=11008,
        vocab_size=151936, tie_word_embeddings=True,
    ),
    "7b": dict(
        hidden_size=3584, num_hidden_layers=28, num_attention_heads=28, num_key_value_heads=4, intermediate_size=18944,
        vocab_size=152064, tie_word_embeddings=False,
    ),
}
COMMON = dict(
    rms_norm_eps=1e-6, rope_theta=1e6, rope_scaling={"type": "mrope", "mrope_section": [16, 24, 24]}, hidden_act="silu",
    max_position_embeddings=128000, use_sliding_window=False, image_token_id=151655, video_token_id=151656,
    vision_start_token_id=151652, vision_end_token_id=151653,
)
VISION = dict(
    depth=32, hidden_size=1280, intermediate_size=3420, num_heads=16, in_channels=3, patch_size=14, spatial_merge_size=2,
    temporal_patch_size=2, window_size=112, fullatt_block_indexes=[7, 15, 23, 31], tokens_per_second=2, hidden_act="silu",
)
MEAN, STD = [0.48145466, 0.4578275, 0.40821073], [0.26862954, 0.26130258, 0.27577711]
DIGITS = list(range(15, 25))


def config(size, layers=None):
    """The configuration of a published size, perhaps with fewer layers of text."""
    vision = VISION | {"out_hidden_size": SIZES[size]["hidden_size"]}
    shape = SIZES[size] | ({"num_hidden_layers": layers} if layers else {})
    return Qwen2_5_VLConfig(**COMMON, **shape, vision_config=vision)


def config_of(directory):
    """The configuration of a checkpoint directory."""
    return AutoConfig.from_pretrained(directory)


def base(config, dtype, device):
    """A base with random weights; on the device `meta`, one that has shapes alone."""
    config._attn_implementation = "sdpa"
    with torch.device("meta"):
        model = Qwen2_5_VLForConditionalGeneration._from_config(config, dtype=dtype)
    if str(device) == "meta":
        return model
    model.to_empty(device=device)
    model.tie_weights()
    # What no state dict holds is empty now.
    text, tower = model.model.language_model, model.model.visual
    text.rotary_emb = type(text.rotary_emb)(config=text.config).to(device)
    tower.rotary_pos_emb = type(tower.rotary_pos_emb)(config=tower.config).to(device)
    # Drawn once and repeated: billions of draws take minutes.
    noise = (torch.randn(1 << 20, generator=torch.Generator().manual_seed(1)) * 0.02).to(device, dtype)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if parameter.dim() == 1:
                parameter.fill_(0.0 if name.endswith("bias") else 1.0)
            else:
                for part in parameter.view(-1).split(len(noise)):
                    part.copy_(noise[: len(part)])
    return model


def read_base(directory, dtype):
    """A published checkpoint, or one that was saved as one."""
    return Qwen2_5_VLForConditionalGeneration.from_pretrained(directory, dtype=dtype, attn_implementation="sdpa")


def image_numbers(directory):
    """Mean and spread of the picture's channels, of preprocessor_config.json."""
    image = json.loads((Path(directory) / "preprocessor_config.json").read_text())
    return image["image_mean"], image["image_std"]


def made_up(config, settings, size, told, asked, frames, seed=0):
    """Frames of noise with prompts of the length that `sdim-tiny`'s way of asking has: a token per measurement, one per question."""
    random, (width, height) = np.random.default_rng(seed), size
    side = config.vision_config.patch_size * config.vision_config.spatial_merge_size
    rows, cols, bins = height // side, width // side, settings["number"]["bins"]

    def at_pixels(count, time):
        x, y = random.integers(width, size=count), random.integers(height, size=count)
        place = np.stack([np.full(count, 1 + time), 1 + y / side, 1 + x / side, x, y], -1)
        return FIRST_ADDED + random.integers(bins, size=count), place.astype(np.float32)

    def example():
        y, x = np.mgrid[:rows, :cols].reshape(2, -1)
        nowhere = np.full(rows * cols + 2, np.nan)
        time = np.concatenate([[0], np.ones(rows * cols), [1 + max(rows, cols)]])
        down, right = (np.concatenate([[0], 1 + t, [time[-1]]]) for t in (y, x))
        opening = np.stack([time, down, right, nowhere, nowhere], -1).astype(np.float32)
        start, end = config.vision_start_token_id, config.vision_end_token_id
        ids = [start, *[config.image_token_id] * (rows * cols), end]
        (told_ids, told_places), (asked_ids, asked_places) = at_pixels(told, 1.0), at_pixels(asked, 2.0)
        prompt, value = len(ids) + told, random.uniform(0.5, 2.0, asked).astype(np.float32)
        return dict(
            rgb=random.integers(256, size=(height, width, 3), dtype=np.uint8),
            depth=(random.random((height, width)) < told / (height * width)).astype(np.float32),
            ids=np.concatenate([ids, told_ids, asked_ids]),
            places=np.concatenate([opening, told_places, asked_places]),
            group=np.concatenate([np.zeros(prompt, np.int64), 1 + np.arange(asked)]),
            predict=prompt + np.arange(asked),
            answer=random.integers(bins, size=asked),
            question=np.arange(asked),
            value=value,
            hint=value,
            scale=np.full(asked, 2.0, np.float32),
        )

    return collate([example() for _ in range(frames)])
