#!/usr/bin/env python3
"""A checkpoint of the full Qwen2.5-VL-3B shapes with random bf16 weights, and what the reference answers with it.

    pip install -r tests/reference/requirements.txt
    python tests/reference/full_3b.py write DIR TOKENIZER      7.5 GB of shards, a frame, 10 measurements and a question into DIR
    python tests/reference/full_3b.py run DIR f32              about 17 GB of memory, minutes; writes reference_f32.json
    python tests/reference/full_3b.py run DIR bf16             about 9 GB; writes reference_bf16.json
    cargo run --release --example ask -- --model DIR --image DIR/frame.png --prompt "$(cat DIR/question.txt)" \
        --max-new-tokens 8 --repetition-penalty 1 --json > ours.json
    python tests/reference/full_3b.py compare DIR/reference_f32.json ours.json
    cargo run --release --example complete -- --model DIR --rgb DIR/frame.png --sparse DIR/sparse.npy \
        --plan budget:64 --weights bf16 --json          64 pixels by the paper's prompt, 10 measurements asked beside them

TOKENIZER is a directory with the published `tokenizer.json`, `tokenizer_config.json`, `chat_template.json` and
`preprocessor_config.json`. `compare` needs nothing but Python: same prompt, the 20 best ids of the first token the same
in the same order, their logits within 1e-3, greedy ids the same (with `--loose` for bf16: it only prints the differences).
"""

import argparse
import json
import math
import pathlib
import resource
import shutil
import sys
import time

QUESTION = "How far away is the black square in front of the striped wall, in metres?"
NEW_TOKENS = 8
TOP = 20
USED_IDS = 151665  # the tokenizer's; the embedding has more rows
TOKENIZER_FILES = [
    "tokenizer.json", "tokenizer_config.json", "chat_template.json", "chat_template.jinja", "preprocessor_config.json",
]
GENERATION = {
    "bos_token_id": 151643, "pad_token_id": 151643, "eos_token_id": [151645, 151643], "do_sample": True,
    "temperature": 1e-6, "repetition_penalty": 1.05,
}
# Sizes and ids of the published 3B model.
CONFIG = {
    "architectures": ["Qwen2_5_VLForConditionalGeneration"], "model_type": "qwen2_5_vl", "attention_dropout": 0.0,
    "bos_token_id": 151643, "eos_token_id": 151645, "vision_start_token_id": 151652, "vision_end_token_id": 151653,
    "vision_token_id": 151654, "image_token_id": 151655, "video_token_id": 151656, "hidden_act": "silu",
    "hidden_size": 2048, "intermediate_size": 11008, "max_position_embeddings": 128000, "max_window_layers": 70,
    "num_attention_heads": 16, "num_hidden_layers": 36, "num_key_value_heads": 2, "rms_norm_eps": 1e-6,
    "rope_theta": 1e6, "rope_scaling": {"type": "mrope", "mrope_section": [16, 24, 24]}, "sliding_window": 32768,
    "use_sliding_window": False, "tie_word_embeddings": True, "torch_dtype": "bfloat16", "vocab_size": 151936,
    "vision_config": {
        "depth": 32, "hidden_act": "silu", "hidden_size": 1280, "intermediate_size": 3420, "num_heads": 16,
        "in_chans": 3, "out_hidden_size": 2048, "patch_size": 14, "spatial_merge_size": 2, "spatial_patch_size": 14,
        "window_size": 112, "fullatt_block_indexes": [7, 15, 23, 31], "tokens_per_second": 2, "temporal_patch_size": 2,
    },
}


def picture():
    """640 x 480 with edges, gradients and noise."""
    import numpy as np
    from PIL import Image

    rng = np.random.default_rng(640)
    y, x = np.mgrid[:480, :640]
    values = np.stack([127 + 100 * np.sin(x / (17 + 9 * c) + y / (31 - 7 * c) + c) for c in range(3)], -1)
    values[(x // 40) % 3 == 0] *= 0.4
    values += rng.normal(0, 12, values.shape)
    values[250:380, 300:430] = 10
    return Image.fromarray(values.clip(0, 255).astype(np.uint8), "RGB")


def values_of(name, shape, generator):
    """Random values under which a stream keeps its size through the layers and the best logits stand apart."""
    import torch

    noise = torch.randn(shape, generator=generator)
    if "norm" in name or "ln_q" in name:
        return 1 + 0.1 * noise
    if len(shape) == 1:
        return 0.1 * noise
    if "embed_tokens" in name:
        # Rows of unequal lengths spread the best logits; rows without a token are small, as in the published weights.
        noise *= 0.08 * torch.exp(0.5 * torch.randn((shape[0], 1), generator=generator))
        noise[USED_IDS:] *= 1e-3
        return noise
    # Decoder layers add much more than the embedding, or the last token would always name itself.
    gains = {"qkv": 1.2, "q_proj": 1.2, "k_proj": 1.2, "o_proj": 2.0, "attn.proj": 0.7, "blocks": 0.9, "down_proj": 2.5}
    gain = next((g for part, g in gains.items() if part in name), 1.0)
    return noise.mul_(gain / math.sqrt(math.prod(shape[1:])))


def write(out, tokenizer):
    import numpy as np
    import torch
    import transformers

    out.mkdir(parents=True, exist_ok=True)
    config = transformers.Qwen2_5_VLConfig(**json.loads(json.dumps(CONFIG)))
    config.dtype = torch.bfloat16
    with torch.device("meta"):
        model = transformers.Qwen2_5_VLForConditionalGeneration(config).to(torch.bfloat16)
    assert config.text_config.num_key_value_heads == 2 and config.text_config.rope_parameters["rope_theta"] == 1e6
    generator = torch.Generator().manual_seed(3)
    # In the order of the names, so that the values do not depend on the order of the modules.
    shapes = sorted((name, tuple(p.shape)) for name, p in model.named_parameters() if "lm_head" not in name)
    state = {name: values_of(name, shape, generator).to(torch.bfloat16) for name, shape in shapes}
    count = sum(t.numel() for t in state.values())
    print(f"{len(state)} tensors, {count} values")
    assert (len(state), count) == (824, 3_754_622_976), "not the published sizes"
    state["lm_head.weight"] = state["model.language_model.embed_tokens.weight"]
    model.load_state_dict(state, assign=True)
    model.tie_weights()
    model.generation_config = transformers.GenerationConfig(**GENERATION)
    model.save_pretrained(out, max_shard_size="4GB")
    index = json.loads((out / "model.safetensors.index.json").read_text())["weight_map"]
    assert len(index) == 824 and "visual.patch_embed.proj.weight" in index and "lm_head.weight" not in index
    for name in TOKENIZER_FILES:
        if (tokenizer / name).exists():
            shutil.copyfile(tokenizer / name, out / name)
    picture().save(out / "frame.png")
    (out / "question.txt").write_text(QUESTION)
    rng = np.random.default_rng(10)
    sparse = np.zeros((480, 640), np.float32)
    sparse.flat[rng.choice(sparse.size, 10, replace=False)] = rng.uniform(1, 9, 10)
    np.save(out / "sparse.npy", sparse)


def inputs_of(out):
    """The prompt as the reference's processor makes it, resized by Pillow (and not by torchvision, the default of 5)."""
    import numpy as np
    import torch
    from PIL import Image
    from transformers import AutoTokenizer
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

    tokenizer = AutoTokenizer.from_pretrained(out)
    template = json.loads((out / "chat_template.json").read_text())["chat_template"]
    message = {"role": "user", "content": [{"type": "image"}, {"type": "text", "text": QUESTION}]}
    text = tokenizer.apply_chat_template([message], chat_template=template, tokenize=False, add_generation_prompt=True)
    image = Image.open(out / "frame.png")
    made = Qwen2VLImageProcessorPil.from_pretrained(out)(images=[image], return_tensors="pt")
    grid = made["image_grid_thw"]
    text = text.replace("<|image_pad|>", "<|image_pad|>" * int(grid.prod() // 4))
    ids = torch.tensor(np.array([tokenizer(text)["input_ids"]]))
    kinds = (ids == CONFIG["image_token_id"]).int()
    return {
        "input_ids": ids, "attention_mask": torch.ones_like(ids), "mm_token_type_ids": kinds,
        "pixel_values": made["pixel_values"].float(), "image_grid_thw": grid,
    }


def run(out, kind):
    import torch
    import transformers

    inputs = inputs_of(out)
    dtype = {"f32": torch.float32, "bf16": torch.bfloat16}[kind]
    start = time.monotonic()
    model = transformers.Qwen2_5_VLForConditionalGeneration.from_pretrained(
        out, dtype=dtype, attn_implementation="eager"
    ).eval()
    print(f"loaded after {time.monotonic() - start:.0f} s", flush=True)
    options = transformers.GenerationConfig(
        max_new_tokens=NEW_TOKENS, do_sample=False, repetition_penalty=1.0, bos_token_id=151643, pad_token_id=151643,
        eos_token_id=[151645, 151643], output_logits=True, return_dict_in_generate=True,
    )
    with torch.no_grad():
        made = model.generate(**inputs, generation_config=options)
    logits = made.logits[0][0].float()
    top = logits.topk(TOP + 1)
    count = inputs["input_ids"].shape[1]
    position = model.model.rope_deltas
    assert int(position) < 0, "one-dimensional positions"
    result = {
        "made_with": f"transformers {transformers.__version__}, torch {torch.__version__}, {kind}",
        "prompt_ids": inputs["input_ids"][0].tolist(),
        "grid_thw": inputs["image_grid_thw"][0].tolist(),
        "rope_delta": int(position),
        "generated_ids": made.sequences[0, count:].tolist(),
        "first_logits_top": [[i, v] for i, v in zip(top.indices[:TOP].tolist(), top.values[:TOP].tolist())],
        "first_logits_std": float(logits[:USED_IDS].std()),
    }
    # Closer values could not be told apart in f32.
    gaps = (top.values[:-1] - top.values[1:]) / top.values[:-1].abs()
    step = [float((s[0].float().topk(2).values * torch.tensor([1.0, -1.0])).sum()) for s in made.logits]
    (out / f"reference_{kind}.json").write_text(json.dumps(result) + "\n")
    assert kind != "f32" or gaps.min() > 2e-4, "the best ids are too close to be told apart; ask another question"
    print(f"smallest relative gap of the best {TOP + 1}: {float(gaps.min()):.1e}; gaps of each step's best two: {step}")
    print(f"best: {result['first_logits_top'][:4]}, std {result['first_logits_std']:.3f}; ids {result['generated_ids']}")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{time.monotonic() - start:.0f} s, peak {peak:.1f} GiB")


def compare(wanted, ours, loose):
    wanted, ours = (json.loads(path.read_text()) for path in (wanted, ours))
    wrong = []
    if wanted["prompt_ids"] != ours["prompt_ids"]:
        wrong.append(f"the prompts differ ({len(ours['prompt_ids'])} ids, {len(wanted['prompt_ids'])} expected)")
    ids = [[i for i, _ in side["first_logits_top"][:TOP]] for side in (wanted, ours)]
    if ids[0] != ids[1]:
        wrong.append(f"best ids {ids[1]}, expected {ids[0]}")
    values = dict(map(tuple, ours["first_logits_top"]))
    differences = [abs(values[i] - v) / abs(v) for i, v in wanted["first_logits_top"] if i in values]
    worst = max(differences, default=math.inf)
    print(f"{len(differences)} of {TOP} best ids in common, largest relative difference of their logits {worst:.1e}")
    if len(differences) < TOP or not worst <= 1e-3:
        wrong.append(f"logits differ by {worst:.1e}, allowed 1e-3")
    if wanted["generated_ids"] != ours["generated_ids"]:
        wrong.append(f"answered {ours['generated_ids']}, expected {wanted['generated_ids']}")
    print("\n".join(wrong) if wrong else "agrees")
    sys.exit(1 if wrong and not loose else 0)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    arguments = {
        "write": ["out", "tokenizer"], "run": ["out", "kind"], "compare": ["wanted", "ours"],
    }
    for command, names in arguments.items():
        sub = commands.add_parser(command)
        for name in names:
            sub.add_argument(name, **({"choices": ["f32", "bf16"]} if name == "kind" else {"type": pathlib.Path}))
    sub.add_argument("--loose", action="store_true")
    given = parser.parse_args()
    if given.command == "write":
        write(given.out, given.tokenizer)
    elif given.command == "run":
        run(given.out, given.kind)
    else:
        compare(given.wanted, given.ours, given.loose)


if __name__ == "__main__":
    main()
