#!/usr/bin/env python3
"""Times PyTorch + transformers on the work of `examples/throughput`: vision encoder, prompt, pixel queries.

    pip install -r tests/reference/requirements.txt
    python benches/peers/shared_prefix.py --shapes 3b --queries 64 --suffix-tokens 1 --digits 5

Random bf16 weights. Queries share the prompt's keys and values, which are repeated over the batch by hand: what a careful
user would write. `--plain N` also times N queries by `generate`, each with its own image: what most users would write.
"""

import argparse
import copy
import json
import resource
import time

import torch
import transformers
from transformers import DynamicCache

BEFORE, AFTER = 15, 5


def config(shapes):
    hidden, inner, layers, heads, kv, vocab, tied = {
        "3b": (2048, 11008, 36, 16, 2, 151936, True), "7b": (3584, 18944, 28, 28, 4, 152064, False),
    }[shapes]
    return transformers.Qwen2_5_VLConfig(
        hidden_size=hidden, intermediate_size=inner, num_hidden_layers=layers, num_attention_heads=heads,
        num_key_value_heads=kv, vocab_size=vocab, tie_word_embeddings=tied, rms_norm_eps=1e-6, rope_theta=1e6,
        rope_scaling={"type": "mrope", "mrope_section": [16, 24, 24]}, vision_start_token_id=151652,
        vision_end_token_id=151653, image_token_id=151655, video_token_id=151656,
        vision_config={"depth": 32, "hidden_size": 1280, "intermediate_size": 3420, "num_heads": 16,
                       "out_hidden_size": hidden, "patch_size": 14, "spatial_merge_size": 2,
                       "temporal_patch_size": 2, "window_size": 112, "fullatt_block_indexes": [7, 15, 23, 31]},
    )


def build(shapes):
    torch.set_default_dtype(torch.bfloat16)
    with torch.device("meta"):
        model = transformers.Qwen2_5_VLForConditionalGeneration(config(shapes)).eval()
    rotary = [m for m in model.modules() if "Rotary" in type(m).__name__]
    model = model.to_empty(device="cpu")
    for p in model.parameters():
        p.data.uniform_(-1.7 / p.shape[-1] ** 0.5, 1.7 / p.shape[-1] ** 0.5) if p.dim() > 1 else p.data.fill_(1)
    torch.set_default_dtype(torch.float32)
    for m in rotary:  # buffers that are computed, not loaded
        fresh = type(m)(m.config) if hasattr(m, "config") else type(m)(40)
        for name, buffer in fresh.named_buffers():
            setattr(m, name, buffer)
    model.tie_weights()
    return model


def timed(f):
    start = time.perf_counter()
    out = f()
    return out, time.perf_counter() - start


def repeat(cache, n):
    """The prompt's cache for a batch; `expand` where the cache allows it would still be copied by its first update."""
    out = copy.deepcopy(cache)
    out.batch_repeat_interleave(n)
    return out


@torch.inference_mode()
def main():
    a = argparse.ArgumentParser()
    a.add_argument("--shapes", default="3b")
    a.add_argument("--width", type=int, default=644)
    a.add_argument("--height", type=int, default=476)
    a.add_argument("--queries", type=int, default=64)
    a.add_argument("--suffix-tokens", type=int, default=1)
    a.add_argument("--digits", type=int, default=5)
    a.add_argument("--batch", type=int, default=64)
    a.add_argument("--plain", type=int, default=0)
    a = a.parse_args()
    model = build(a.shapes)
    gh, gw = a.height // 28 * 2, a.width // 28 * 2
    grid = torch.tensor([[1, gh, gw]])
    pixels = torch.randn(gh * gw, 1176).to(torch.bfloat16)
    visual, text = model.model.visual, model.model.language_model
    visual(pixels, grid_thw=grid)
    _, vision_s = timed(lambda: visual(pixels, grid_thw=grid))
    tokens = gh * gw // 4
    ids = torch.tensor([[11] * BEFORE + [151655] * tokens + [12] * AFTER])
    inputs = {"input_ids": ids, "pixel_values": pixels, "image_grid_thw": grid, "attention_mask": torch.ones_like(ids),
              "mm_token_type_ids": (ids == 151655).int()}

    # The prompt by the model's own code; its vision encoder's time is taken off.
    def prompt():
        cache = DynamicCache()
        model.model(**inputs, past_key_values=cache, use_cache=True)
        return cache

    prefix, both = timed(prompt)
    length = ids.shape[1]
    at = BEFORE + max(gh, gw) // 2 + AFTER
    head = model.lm_head.weight[13:24]

    def ask(n):
        cache = repeat(prefix, n)
        ids = torch.randint(11, 24, (n, a.suffix_tokens))
        start, passed = at, length
        for _ in range(a.digits):
            rows = ids.shape[1]
            position = torch.arange(start, start + rows).expand(3, n, rows)
            out = text(input_ids=ids, position_ids=position, past_key_values=cache, use_cache=True,
                       cache_position=torch.arange(passed, passed + rows))
            logits = out.last_hidden_state[:, -1] @ head.T
            ids = 13 + logits.argmax(-1, keepdim=True)
            start, passed = start + rows, passed + rows

    def all_queries():
        left = a.queries
        while left > 0:
            ask(min(left, a.batch))
            left -= a.batch

    ask(2)
    _, queries_s = timed(all_queries)
    result = {"vision_s": vision_s, "prefill_s": both - vision_s, "queries_s": queries_s, "queries": a.queries,
              "queries_per_second": a.queries / queries_s, "tokens_per_query": a.suffix_tokens + a.digits - 1}
    if a.plain:
        ids = torch.cat([ids, torch.randint(11, 24, (1, a.suffix_tokens))], 1)
        inputs |= {"input_ids": ids, "attention_mask": torch.ones_like(ids), "mm_token_type_ids": (ids == 151655).int()}
        options = transformers.GenerationConfig(max_new_tokens=a.digits, min_new_tokens=a.digits, do_sample=False,
                                                pad_token_id=0, eos_token_id=None)

        def plain():
            for _ in range(a.plain):
                model.generate(**inputs, generation_config=options)

        _, seconds = timed(plain)
        result["plain_queries_per_second"] = a.plain / seconds
    result["threads"] = torch.get_num_threads()
    result["peak_rss_bytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(json.dumps(result))


main()
