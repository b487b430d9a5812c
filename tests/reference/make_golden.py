#!/usr/bin/env python3
"""Writes tests/fixtures/qwen_small: a small random Qwen2.5-VL with golden tensors of the reference implementation.

    pip install -r tests/reference/requirements.txt     (transformers 5.23.0, torch 2.15.0, pillow 12.0.0, Python 3.11)
    python tests/reference/make_golden.py [DIRECTORY]

All values come from `transformers` itself: module outputs are caught by hooks, indices by wrapping the functions that
compute them. Nothing of the architecture is restated here, so that a misreading of it cannot hide in both places.

Keys are `{case}.{name}`; case a and b are prompts with one image, ab has both, c is resized only. `patch_embed`,
`vision_cos`, `vision_sin` and `vision_pos_hw` are in the order of the patches, `vision_block_i` and
`merger_window_order` in window order, `merged` in the order of the image tokens. `text_layer_i` are outputs of decoder
layers, `step_logits` the logits of each step of greedy generation, `generated_ids_rp105` is greedy with repetition
penalty 1.05. Rows of `smart_resize` are height, width, factor, min_pixels, max_pixels, height, width.
"""

import json
import pathlib
import sys
import tempfile

import numpy as np
import PIL
import torch
import transformers
from PIL import Image
from safetensors.torch import load_file, save_file
from transformers.models.qwen2_5_vl import modeling_qwen2_5_vl as reference
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil, smart_resize

OUT = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else pathlib.Path(__file__).parents[1] / "fixtures/qwen_small")
STEPS = 12
VISION_START, VISION_END, VISION_PAD, IMAGE, VIDEO, EOS, BOS = range(297, 304)

# Three query heads per key head, a head of 8 in the decoder and of 20 in the encoder, windows of 3 x 3 tokens that
# divide neither image, a decoder eps unlike the encoder's fixed one, a tied head: all unlike the published sizes'
# convenient multiples.
CONFIG = {
    "architectures": ["Qwen2_5_VLForConditionalGeneration"],
    "model_type": "qwen2_5_vl",
    "bos_token_id": BOS,
    "eos_token_id": EOS,
    "vision_start_token_id": VISION_START,
    "vision_end_token_id": VISION_END,
    "vision_token_id": VISION_PAD,
    "image_token_id": IMAGE,
    "video_token_id": VIDEO,
    "hidden_act": "silu",
    "hidden_size": 48,
    "intermediate_size": 88,
    "num_attention_heads": 6,
    "num_key_value_heads": 2,
    "num_hidden_layers": 3,
    "rms_norm_eps": 1e-4,
    "rope_theta": 20000.0,
    "rope_scaling": {"type": "mrope", "mrope_section": [1, 2, 1]},
    "max_position_embeddings": 4096,
    "max_window_layers": 70,
    "sliding_window": 32768,
    "use_sliding_window": False,
    "attention_dropout": 0.0,
    "tie_word_embeddings": True,
    "torch_dtype": "float32",
    "vocab_size": 304,
    "vision_config": {
        "hidden_act": "silu",
        "depth": 3,
        "hidden_size": 40,
        "intermediate_size": 52,
        "num_heads": 2,
        "in_chans": 3,
        "patch_size": 6,
        "spatial_patch_size": 6,
        "spatial_merge_size": 2,
        "temporal_patch_size": 2,
        "window_size": 36,
        "tokens_per_second": 2,
        "fullatt_block_indexes": [1],
        "out_hidden_size": 48,
    },
}
PREPROCESSOR = {
    "image_processor_type": "Qwen2VLImageProcessor",
    "min_pixels": 4000,
    "max_pixels": 5200,
    "patch_size": 6,
    "temporal_patch_size": 2,
    "merge_size": 2,
    "image_mean": [0.48145466, 0.4578275, 0.40821073],
    "image_std": [0.26862954, 0.26130258, 0.27577711],
}
# Height, width. a is below min_pixels and grows, b is above max_pixels and shrinks, c rounds both sides at a tie (to
# even) and loses height while it gains width, where the order of the two passes matters most.
SIZES = {"a": (50, 71), "b": (83, 151), "c": (78, 66)}


def picture(name, height, width):
    """Sharp edges, gradients and noise, so that every part of the resize shows."""
    rng = np.random.default_rng(ord(name))
    y, x = np.mgrid[:height, :width]
    waves = [127 + 120 * np.sin(x / (3 + c) + y / (7 - c) + c) for c in range(3)]
    values = np.stack(waves, -1)
    values[(x // 9 + y // 7) % 3 == 0] = rng.integers(0, 256, 3)
    values[height // 3 : height // 2] = rng.integers(0, 2, (height // 2 - height // 3, width, 1)) * 255
    return Image.fromarray(values.clip(0, 255).astype(np.uint8), "RGB")


def assert_columns_first(image, size, method=Image.BICUBIC):
    """The fixture must hold the resize of Pillow before 13: horizontal pass, rounded to u8, then vertical pass."""
    twice = image.resize((size[0], image.height), method).resize(size, method)
    assert np.array_equal(np.asarray(image.resize(size, method)), np.asarray(twice)), PIL.__version__


def unpatch(rows, grid, p):
    """The resized picture back from the rows of the processor."""
    _, gh, gw = grid
    x = rows.reshape(gh // 2, gw // 2, 2, 2, 3, 2, p, p)[:, :, :, :, :, 0]
    x = x.transpose(0, 2, 5, 1, 3, 6, 4).reshape(gh * p, gw * p, 3)
    values = x * np.array(PREPROCESSOR["image_std"]) + np.array(PREPROCESSOR["image_mean"])
    u8 = np.rint(values * 255)
    assert np.abs(values * 255 - u8).max() < 1e-2
    return u8.astype(np.uint8)


def preprocess(golden):
    processor = Qwen2VLImageProcessorPil(**{k: v for k, v in PREPROCESSOR.items() if k != "image_processor_type"})
    out = {}
    for name, size in SIZES.items():
        image = picture(name, *size)
        image.save(OUT / f"image_{name}.png", optimize=True)
        made = processor(images=[image], return_tensors="pt")
        rows, grid = made["pixel_values"].float(), made["image_grid_thw"]
        resized = unpatch(rows.numpy(), grid[0].tolist(), PREPROCESSOR["patch_size"])
        assert_columns_first(image, (resized.shape[1], resized.shape[0]))
        plain = image.resize((resized.shape[1], resized.shape[0]), Image.BICUBIC)
        assert np.array_equal(np.asarray(plain), resized), "the processor resizes otherwise than Pillow"
        golden[f"{name}.resized_u8"] = torch.from_numpy(resized)
        if name == "b":  # the largest; the others follow the same code
            golden[f"{name}.pixel_values"] = rows
        out[name] = (rows, grid)
    return out


def resized_sizes():
    """Sizes before and after: random ones, ties, thin and tiny images, under several limits."""
    rng = np.random.default_rng(3)
    sides = np.concatenate([np.exp(rng.uniform(0, 8.3, (180, 2))).astype(int), rng.integers(1, 60, (60, 2)) * 14])
    limits = [(28, 3136, 12845056), (28, 200704, 1003520), (12, 4000, 5200), (28, 3136, 50176)]
    rows = []
    for i, (h, w) in enumerate(sides.tolist()):
        if max(h, w) <= 200 * min(h, w):
            factor, low, high = limits[i % len(limits)]
            rows.append([h, w, factor, low, high, *smart_resize(h, w, factor, low, high)])
    return torch.tensor(rows)


def random_model():
    torch.manual_seed(20252)
    config = transformers.Qwen2_5_VLConfig(**json.loads(json.dumps(CONFIG)))
    config._attn_implementation = "eager"
    model = transformers.Qwen2_5_VLForConditionalGeneration(config).float().eval()
    text, vision = config.text_config, config.vision_config
    assert (text.hidden_size, text.num_key_value_heads, vision.window_size) == (48, 2, 36), "the flat config was read"
    assert text.rope_parameters["rope_theta"] == 20000.0 and text.rms_norm_eps == 1e-4
    with torch.no_grad():
        for name, p in model.named_parameters():
            if "norm" in name or "ln_q" in name:
                p.copy_(1 + 0.2 * torch.randn_like(p))
            elif p.dim() == 1:
                p.copy_(0.2 * torch.randn_like(p))
            elif "embed_tokens" in name:
                p.copy_(0.15 * torch.randn_like(p))
            else:
                # Patches so small that an epsilon shows; queries and keys so large that attention is far from uniform,
                # so that a mixed-up position shows.
                gains = {"patch_embed": 0.03, "qkv": 1.8, "q_proj": 1.8, "k_proj": 1.8}
                gain = next((g for part, g in gains.items() if part in name), 1.0)
                p.copy_(gain * torch.randn_like(p) / p[0].numel() ** 0.5)
    assert model.lm_head.weight is model.model.language_model.embed_tokens.weight
    return model


def save_model(model):
    """Under the published names, which is what save_pretrained writes."""
    with tempfile.TemporaryDirectory() as temporary:
        model.save_pretrained(temporary)
        tensors = load_file(pathlib.Path(temporary) / "model.safetensors")
        nested = json.loads((pathlib.Path(temporary) / "config.json").read_text())
    assert "visual.patch_embed.proj.weight" in tensors and "model.embed_tokens.weight" in tensors
    assert "lm_head.weight" not in tensors and "text_config" in nested
    save_file(tensors, OUT / "model.safetensors", metadata={"format": "pt"})
    for name, value in [("config", CONFIG), ("preprocessor_config", PREPROCESSOR), ("config_nested", nested)]:
        (OUT / f"{name}.json").write_text(json.dumps(value, indent=1) + "\n")


class Catch:
    """Module outputs and index functions of one forward pass."""

    def __init__(self, model, golden, case, full, tables):
        self.golden, self.case, self.handles, self.patched = golden, case, [], []
        visual, text = model.model.visual, model.model.language_model
        self.hook(visual.patch_embed, "patch_embed")
        for i, block in enumerate(visual.blocks):
            if full or i == len(visual.blocks) - 1:
                self.hook(block, f"vision_block_{i}")
        self.hook(visual.merger, "merger_window_order")
        for i, layer in enumerate(text.layers):
            self.hook(layer, f"text_layer_{i}")
        self.hook(text.norm, "text_final_norm")
        if tables:
            self.hook(visual.rotary_pos_emb, "vision_cos", "vision_sin")
            self.hook(text.rotary_emb, "text_cos", "text_sin")
        self.handles.append(text.register_forward_pre_hook(self.text_input, with_kwargs=True))
        self.wrap("get_vision_window_index", "window_index", "cu_window_seqlens")
        self.wrap("get_vision_attention_seqlens", "cu_seqlens")
        self.wrap("get_vision_position_ids", "vision_pos_hw")

    def put(self, names, value):
        for name, tensor in zip(names, value if isinstance(value, tuple) else (value,)):
            while tensor.dim() > 2 and tensor.shape[0] == 1:
                tensor = tensor[0]
            self.golden[f"{self.case}.{name}"] = tensor.detach().clone()

    def hook(self, module, *names):
        self.handles.append(module.register_forward_hook(lambda _m, _i, out: self.put(names, out)))

    def text_input(self, _module, _args, kwargs):
        self.put(["inputs_embeds"], kwargs["inputs_embeds"])
        position = kwargs["position_ids"]
        assert position is not None and position.shape[:2] == (3, 1), "one-dimensional positions"
        self.golden[f"{self.case}.position_ids"] = position[:, 0].clone()

    def wrap(self, function, *names):
        original = getattr(reference, function)

        def caught(*args, **kwargs):
            out = original(*args, **kwargs)
            self.put(names, out)
            return out

        self.patched.append((function, original))
        setattr(reference, function, caught)

    def close(self):
        for handle in self.handles:
            handle.remove()
        for function, original in self.patched:
            setattr(reference, function, original)


def prompt(tokens, rng):
    ids = rng.integers(0, 290, 5).tolist()
    for count in tokens:
        ids += [VISION_START] + [IMAGE] * count + [VISION_END] + rng.integers(0, 290, 4).tolist()
    return torch.tensor([ids])


def run_case(model, golden, images, case):
    rows = torch.cat([images[c][0] for c in case])
    grids = torch.cat([images[c][1] for c in case])
    ids = prompt((grids.prod(1) // 4).tolist(), np.random.default_rng(len(case) * 100 + ord(case[0])))
    # Without mm_token_type_ids transformers 5 falls back to one-dimensional positions and says nothing.
    kinds = (ids == IMAGE).int()
    inputs = {"input_ids": ids, "pixel_values": rows, "image_grid_thw": grids, "mm_token_type_ids": kinds}
    golden[f"{case}.input_ids"], golden[f"{case}.grid_thw"] = ids[0], grids
    catch = Catch(model, golden, case, full=case != "ab", tables=case == "b")
    features = model.model.get_image_features(rows, grids, return_dict=True).pooler_output
    out = model(**inputs, attention_mask=torch.ones_like(ids), use_cache=False)
    catch.close()
    golden[f"{case}.merged"] = torch.cat(list(features))
    golden[f"{case}.last_logits"] = out.logits[0, -1]
    position = golden[f"{case}.position_ids"]
    golden[f"{case}.rope_delta"] = torch.tensor([int(position.max()) + 1 - ids.shape[1]])
    assert not torch.equal(position[0], position[1]) and not torch.equal(position[1], position[2])
    for penalty, name in [(1.0, "generated_ids"), (1.05, "generated_ids_rp105")]:
        options = transformers.GenerationConfig(
            max_new_tokens=STEPS, do_sample=False, repetition_penalty=penalty,
            bos_token_id=BOS, pad_token_id=BOS, eos_token_id=None, output_logits=True, output_scores=True,
            return_dict_in_generate=True,
        )
        model.model.rope_deltas = None
        made = model.generate(**inputs, attention_mask=torch.ones_like(ids), generation_config=options)
        golden[f"{case}.{name}"] = made.sequences[0, ids.shape[1] :]
        assert len(golden[f"{case}.{name}"]) == STEPS
        if penalty == 1.0:
            golden[f"{case}.step_logits"] = torch.cat(made.logits)
            assert torch.allclose(made.logits[0][0], out.logits[0, -1], atol=1e-4)
        top = torch.stack([s[0].topk(2).values for s in made.scores])
        gap = float((top[:, 0] - top[:, 1]).min())
        print(f"{case} {name}: {golden[f'{case}.{name}'].tolist()}, smallest gap of the two best {gap:.4f}")
        assert gap > 5e-3, "too close to be decided in f32; take another seed"


@torch.no_grad()
def main():
    assert transformers.__version__ == "5.23.0" and int(PIL.__version__.split(".")[0]) < 13
    torch.set_num_threads(1)
    OUT.mkdir(parents=True, exist_ok=True)
    golden = {"smart_resize": resized_sizes()}
    images = preprocess(golden)
    model = random_model()
    save_model(model)
    for case in ("a", "b", "ab"):
        run_case(model, golden, images, case)
    small = {k: (v.to(torch.int32) if v.dtype == torch.int64 else v).contiguous() for k, v in golden.items()}
    save_file(small, OUT / "golden.safetensors", metadata={
        "made_with": f"transformers {transformers.__version__}, torch {torch.__version__}, pillow {PIL.__version__}",
    })
    for file in OUT.iterdir():
        file.chmod(0o644)
    total = sum(f.stat().st_size for f in OUT.iterdir())
    print(f"{len(small)} tensors, {total} bytes in {OUT}")
    assert total < 1_500_000


if __name__ == "__main__":
    main()
