#!/usr/bin/env python3
"""Writes tests/fixtures/family: golden tensors of six random Qwen2.5-VL of unlike shapes over seven unlike images.

    pip install -r tests/reference/requirements.txt
    python tests/reference/make_family.py [DIRECTORY]

As in make_golden.py, all values come from `transformers` itself: images through `load_image` and the image processor,
intermediate tensors by hooks. `NAME.json` holds a config, a preprocessor config and the prompts; `NAME.safetensors` the
tensors under the keys of make_golden.py, `{case}.{name}`, a case being named by the letters of its images (`-`: none).
Every element of every intermediate is there, as i16: `round(x / max * 32767)` with `max` the largest magnitude, kept as
`{key}.max`; that costs 1.5e-5 of the largest magnitude, where 2e-4 is demanded. `{key}.bf16` is how far the reference in
bf16 is from itself in f32, as largest difference over largest magnitude; the greedy ids of the f32 run are put in.

Weights are not stored: `weight()` here and `tests/common/random.rs` compute the same bits.
"""

import copy
import json
import math
import pathlib
import sys
import tempfile
import zlib

import numpy as np
import PIL
import torch
import transformers
from PIL import Image
from safetensors.torch import save_file
from transformers.image_utils import load_image
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

from make_golden import Catch, assert_columns_first
from make_golden import CONFIG as SMALL

OUT = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else pathlib.Path(__file__).parents[1] / "fixtures/family")
STEPS = 8
# Height, width, mode. `tiny` grows and `large` shrinks under every preprocessor below.
IMAGES = {
    "s": ("square.png", 64, 64, "RGB"),
    "w": ("wide.png", 31, 93, "RGB"),
    "t": ("tall.png", 96, 32, "RGB"),
    "i": ("tiny.png", 9, 11, "RGB"),
    "l": ("large.png", 243, 310, "RGB"),
    "g": ("grey_turned.png", 47, 70, "L"),
    "r": ("transparent.png", 70, 52, "RGBA"),
}


def text(hidden, heads, kv, inner, layers, section, **more):
    return {
        "hidden_size": hidden, "num_attention_heads": heads, "num_key_value_heads": kv, "intermediate_size": inner,
        "num_hidden_layers": layers, "rope_scaling": {"type": "mrope", "mrope_section": section}, **more,
    }


def vision(hidden, heads, inner, depth, patch, merge, window, full, **more):
    return {
        "hidden_size": hidden, "num_heads": heads, "intermediate_size": inner, "depth": depth, "patch_size": patch,
        "spatial_patch_size": patch, "spatial_merge_size": merge, "window_size": window, "fullatt_block_indexes": full,
        **more,
    }


# Each: text, vision, preprocessor, cases. None removes a key, so that the reference's class default counts.
FAMILY = {
    # The heads, patches, windows, rotary sections and epsilons of 3B; all query heads share one key head.
    "like_3b": (
        text(256, 2, 1, 340, 2, [16, 24, 24], rms_norm_eps=1e-6, rope_theta=1e6),
        vision(160, 2, 212, 3, 14, 2, 112, [2]),
        {"min_pixels": 3136, "max_pixels": 24 * 784},
        ["s", "t", "wl", "-"],
    ),
    # Seven query heads per key head and a head of its own, as 7B; full attention in the first and the last block.
    "like_7b": (
        text(112, 14, 2, 148, 3, [1, 1, 2], rms_norm_eps=1e-6, rope_theta=1e6, tie_word_embeddings=False),
        vision(64, 4, 84, 4, 8, 2, 64, [0, 3]),
        {"size": {"shortest_edge": 10 * 256, "longest_edge": 32 * 256}},
        ["s", "w", "t", "i", "l", "g", "r", "tir", "-"],
    ),
    # As many key heads as query heads, 3 x 3 patches per token, windows everywhere. Absent epsilon and tie.
    "merge_3": (
        text(48, 3, 3, 60, 2, [2, 3, 3], rms_norm_eps=None, rope_theta=500.0, tie_word_embeddings=None),
        vision(36, 3, 44, 3, 4, 3, 24, []),
        {"min_pixels": 10 * 144, "max_pixels": 24 * 144, "size": {"shortest_edge": 100, "longest_edge": 200}},
        ["s", "w", "t", "i", "l", "g", "r", "gs"],
    ),
    # One patch per token, full attention everywhere, one vision head, one key head, an odd number of frequencies.
    "merge_1": (
        text(40, 4, 1, 52, 4, [1, 2, 2], rms_norm_eps=1e-3, rope_theta=None),
        vision(24, 1, 30, 3, 10, 1, 50, [0, 1, 2]),
        {"min_pixels": 1200, "size": {"shortest_edge": 1, "longest_edge": 3200}},
        ["s", "w", "t", "i", "l", "g", "r", "ll"],
    ),
    # Windows of a single token; one frame per patch.
    "window_1": (
        text(96, 8, 2, 128, 2, [2, 2, 2], tie_word_embeddings=False),
        vision(48, 2, 60, 3, 6, 2, 12, [1], temporal_patch_size=1),
        {"min_pixels": 10 * 144, "max_pixels": 30 * 144},
        ["s", "w", "t", "i", "l", "g", "r", "wt"],
    ),
    # A window larger than most images whose side no token divides, and an axis without frequencies.
    "window_7": (
        text(64, 4, 4, 80, 2, [0, 5, 3], rope_theta=1e4),
        vision(40, 2, 56, 2, 6, 2, 93, [0]),
        {"min_pixels": 20 * 144, "max_pixels": 84 * 144},
        ["s", "w", "l", "g", "r", "lw"],
    ),
}
NESTED = {"like_7b", "merge_1", "window_7"}
UNIT = 2.0**-23


def picture(name, height, width, mode):
    """Edges, gradients and a little noise."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    y, x = np.mgrid[:height, :width]
    values = np.stack([127 + 90 * np.sin(x / (5 + 3 * c) + y / (11 - 2 * c) + c) for c in range(3)], -1)
    values[(x // 9 + y // 7) % 3 == 0] = rng.integers(0, 256, 3)
    rows = slice(height // 3, height // 3 + max(2, height // 16))
    values[rows] = rng.integers(0, 2, (len(range(*rows.indices(height))), width, 1)) * 255
    values = values.clip(0, 255).astype(np.uint8)
    if mode == "L":
        return Image.fromarray(values[..., 0], "L")
    if mode == "RGBA":
        alpha = ((x * 7 + y * 3) % 256).astype(np.uint8)
        return Image.fromarray(np.dstack([values, alpha]), "RGBA")
    return Image.fromarray(values, "RGB")


def write_images():
    (OUT / "images").mkdir(parents=True, exist_ok=True)
    for name, height, width, mode in IMAGES.values():
        image = picture(name, height, width, mode)
        exif = Image.Exif()
        if "turned" in name:
            exif[0x0112] = 6  # to be turned by 90 degrees
        image.save(OUT / "images" / name, optimize=True, exif=exif)


def published_name(name):
    return name.replace("model.visual.", "visual.").replace("model.language_model.", "model.")


def weight(name, shape):
    """Uniform values whose bits follow from the name; the mixing is the finaliser of MurmurHash3."""
    x = np.arange(math.prod(shape), dtype=np.uint32) * np.uint32(0x9E3779B1) + np.uint32(zlib.crc32(name.encode()))
    x ^= x >> 16
    x *= np.uint32(0x85EBCA6B)
    x ^= x >> 13
    x *= np.uint32(0xC2B2AE35)
    x ^= x >> 16
    unit = (x >> 8).astype(np.float32) * np.float32(UNIT) - np.float32(1)
    offset, gain = 0.0, 0.35
    if "norm" in name or "ln_q" in name:
        offset = 1.0
    elif "embed_tokens" in name:
        gain = 0.25
    elif len(shape) > 1:
        # As in make_golden.py: small patches show an epsilon, large queries and keys a mixed-up position.
        gains = {"patch_embed": 0.05, "qkv": 3.0, "q_proj": 3.0, "k_proj": 3.0}
        gain = next((g for part, g in gains.items() if part in name), 1.75) / math.sqrt(math.prod(shape[1:]))
    values = np.float32(offset) + np.float32(gain) * unit
    return torch.from_numpy(values.reshape(shape))


def configs(name):
    text_config, vision_config, preprocessor, cases = FAMILY[name]
    merged = copy.deepcopy(SMALL) | text_config
    merged["vision_config"] |= vision_config | {"out_hidden_size": text_config["hidden_size"]}
    merged = {k: v for k, v in merged.items() if v is not None}
    own = vision_config.get("temporal_patch_size", 2)
    keys = {"patch_size": vision_config["patch_size"], "merge_size": vision_config["spatial_merge_size"]}
    common = {
        "image_processor_type": "Qwen2VLImageProcessor", "temporal_patch_size": own,
        "image_mean": [0.48145466, 0.4578275, 0.40821073], "image_std": [0.26862954, 0.26130258, 0.27577711],
    }
    return merged, common | keys | preprocessor, cases


def models(flat):
    """The model in f32, and in bf16 as a checkpoint loads (rotary frequencies stay f32)."""
    config = transformers.Qwen2_5_VLConfig(**copy.deepcopy(flat))
    config._attn_implementation = "eager"
    model = transformers.Qwen2_5_VLForConditionalGeneration(config).float().eval()
    assert config.text_config.hidden_size == flat["hidden_size"], "the flat config was read"
    head = "lm_head.weight" if flat.get("tie_word_embeddings") else None
    checksum = 0
    for key, value in sorted((published_name(k), p) for k, p in model.named_parameters()):
        if key != head:
            value.copy_(weight(key, tuple(value.shape)))
            checksum = zlib.crc32(value.numpy().tobytes(), checksum)
    tied = model.lm_head.weight is model.model.language_model.embed_tokens.weight
    assert tied == bool(flat.get("tie_word_embeddings"))
    with tempfile.TemporaryDirectory() as temporary:
        model.save_pretrained(temporary)
        nested = json.loads((pathlib.Path(temporary) / "config.json").read_text())
        half = transformers.Qwen2_5_VLForConditionalGeneration.from_pretrained(
            temporary, dtype=torch.bfloat16, attn_implementation="eager"
        ).eval()
    assert half.model.language_model.rotary_emb.inv_freq.dtype == torch.float32
    assert half.lm_head.weight.dtype == torch.bfloat16
    return model, half, nested, checksum


def preprocess(preprocessor, case):
    if case == "-":
        return None
    processor = Qwen2VLImageProcessorPil.from_dict(copy.deepcopy(preprocessor))
    images = [load_image(str(OUT / "images" / IMAGES[c][0])) for c in case]
    made = processor(images=images, return_tensors="pt")
    for image, (_, gh, gw) in zip(images, made["image_grid_thw"].tolist()):
        p = preprocessor["patch_size"]
        assert_columns_first(image, (gw * p, gh * p))
    return made["pixel_values"].float(), made["image_grid_thw"]


def prompt(merge, flat, grids, seed):
    rng = np.random.default_rng(seed)
    ids = rng.integers(0, 290, 6).tolist()
    for _, gh, gw in grids:
        image = [flat["image_token_id"]] * (gh * gw // merge**2)
        ids += [flat["vision_start_token_id"], *image, flat["vision_end_token_id"], *rng.integers(0, 290, 4).tolist()]
    return torch.tensor([ids])


def generate(model, inputs, penalty):
    options = transformers.GenerationConfig(
        max_new_tokens=STEPS, do_sample=False, repetition_penalty=penalty, bos_token_id=303, pad_token_id=303,
        eos_token_id=None, output_logits=True, output_scores=True, return_dict_in_generate=True,
    )
    model.model.rope_deltas = None
    made = model.generate(**inputs, attention_mask=torch.ones_like(inputs["input_ids"]), generation_config=options)
    top = torch.stack([s[0].topk(2).values for s in made.scores])
    gap = float((top[:, 0] - top[:, 1]).min())
    return made.sequences[0, inputs["input_ids"].shape[1] :], torch.cat(made.logits), gap


def trace(model, inputs, case, following, tables):
    """Every stage of the prompt, and the logits of each step with the ids that follow put in."""
    golden = {}
    catch = Catch(model, golden, case, full=True, tables=tables)
    kinds = inputs["mm_token_type_ids"]
    model.model.rope_deltas = None
    if "pixel_values" in inputs:
        features = model.model.get_image_features(
            inputs["pixel_values"].to(model.dtype), inputs["image_grid_thw"], return_dict=True
        ).pooler_output
        golden[f"{case}.merged"] = torch.cat(list(features))
    else:
        # The reference gives text alone one-dimensional positions; they are the same on the three axes.
        inputs = {"input_ids": inputs["input_ids"], "position_ids": torch.arange(kinds.shape[1]).expand(3, 1, -1)}
    out = model(**inputs, attention_mask=torch.ones_like(inputs["input_ids"]), use_cache=False)
    catch.close()
    golden[f"{case}.last_logits"] = out.logits[0, -1]
    model.model.rope_deltas = None
    ids = torch.cat([inputs["input_ids"], following[None, :-1]], 1)
    more = dict(inputs, input_ids=ids)
    if "position_ids" in inputs:
        more["position_ids"] = torch.arange(ids.shape[1]).expand(3, 1, -1)
    else:
        more["mm_token_type_ids"] = torch.cat([kinds, torch.zeros_like(following[None, :-1], dtype=kinds.dtype)], 1)
    steps = model(**more, attention_mask=torch.ones_like(ids), use_cache=False).logits[0, -STEPS:]
    return golden, steps


def run_case(pair, flat, preprocessor, case, golden):
    model, half = pair
    rows_and_grids = preprocess(preprocessor, case)
    grids = rows_and_grids[1].tolist() if rows_and_grids else []
    for seed in range(100):
        ids = prompt(preprocessor["merge_size"], flat, grids, [seed, *map(ord, case)])
        inputs = {"input_ids": ids, "mm_token_type_ids": (ids == flat["image_token_id"]).int()}
        if rows_and_grids:
            inputs |= {"pixel_values": rows_and_grids[0], "image_grid_thw": rows_and_grids[1]}
        greedy, logits, gap = generate(model, inputs, 1.0)
        penalised, _, other_gap = generate(model, inputs, 1.05)
        # Neither too close to be decided in f32, nor ended early, nor the same without the penalty.
        whole = len(greedy) == len(penalised) == STEPS
        if whole and min(gap, other_gap) > 5e-3 and not torch.equal(greedy, penalised):
            break
    else:
        raise AssertionError("no prompt will do")
    # Text alone at positions 0, 1, 2 ...; an image token among the answers would be replaced by the second pass.
    assert flat["image_token_id"] not in greedy
    tables = not golden or len(case) > 1
    exact, steps = trace(model, inputs, case, greedy, tables)
    rough, rough_steps = trace(half, inputs, case, greedy, tables)
    scale = logits.abs().max()
    assert (steps - logits).abs().max() < 1e-4 * scale, "the cache changes the answer"
    exact[f"{case}.step_logits"], rough[f"{case}.step_logits"] = logits, rough_steps
    for key, value in exact.items():
        value = value.detach()
        if not value.dtype.is_floating_point:
            assert torch.equal(value, rough[key])
            golden[key] = value.to(torch.int32)
            continue
        largest = value.abs().max()
        golden[key] = torch.round(value / largest * 32767).to(torch.int16)
        golden[f"{key}.max"] = largest.reshape(1)
        difference = (rough[key].detach().float() - value) / largest
        golden[f"{key}.bf16"] = torch.stack([difference.abs().max(), difference.square().mean().sqrt()])
    position = exact[f"{case}.position_ids"]
    golden |= {
        f"{case}.input_ids": ids[0].to(torch.int32), f"{case}.generated_ids": greedy.to(torch.int32),
        f"{case}.generated_ids_rp105": penalised.to(torch.int32),
        f"{case}.rope_delta": torch.tensor([int(position.max()) + 1 - ids.shape[1]], dtype=torch.int32),
    }
    if rows_and_grids:
        golden[f"{case}.grid_thw"] = rows_and_grids[1].to(torch.int32)
        checksum = zlib.crc32(rows_and_grids[0].numpy().tobytes())
        golden[f"{case}.pixel_values_crc32"] = torch.tensor([checksum])
    grids = [g[1:] for g in grids]
    last = float(golden[f"{case}.last_logits.bf16"][0])
    print(f"  {case}: patches {grids}, {ids.shape[1]} ids, seed {seed}, gaps {gap:.3f} {other_gap:.3f}, bf16 {last:.3f}")
    return golden


@torch.no_grad()
def main():
    assert transformers.__version__ == "5.23.0" and int(PIL.__version__.split(".")[0]) < 13
    torch.set_num_threads(1)
    write_images()
    for name in FAMILY:
        flat, preprocessor, cases = configs(name)
        model, half, nested, checksum = models(flat)
        golden = {}
        print(name)
        for case in cases:
            golden = run_case((model, half), flat, preprocessor, case, golden)
        save_file({k: v.contiguous() for k, v in golden.items()}, OUT / f"{name}.safetensors", metadata={
            "made_with": f"transformers {transformers.__version__}, torch {torch.__version__}, pillow {PIL.__version__}",
        })
        meta = {
            "config": nested if name in NESTED else flat, "preprocessor_config": preprocessor, "weights_crc32": checksum,
            "cases": cases, "images": {letter: image[0] for letter, image in IMAGES.items()},
        }
        (OUT / f"{name}.json").write_text(json.dumps(meta, indent=1) + "\n")
    total = 0
    for file in OUT.rglob("*.*"):
        file.chmod(0o644)
        total += file.stat().st_size
    print(f"{total} bytes in {OUT}")
    assert total < 6_000_000


if __name__ == "__main__":
    main()
