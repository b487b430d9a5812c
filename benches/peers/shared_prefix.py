#!/usr/bin/env python3
"""Times PyTorch + transformers on the work of `examples/throughput`: vision encoder, prompt, pixel queries.

    pip install -r tests/reference/requirements.txt
    python benches/peers/shared_prefix.py --shapes 3b --queries 64 --suffix-tokens 1 --digits 5
    python benches/peers/shared_prefix.py --shapes 3b --device cuda:0 --queries 4096 --batch 512 --numbers bins --rounds 3

Random bf16 weights. Queries share the prompt's keys and values, by hand: they are computed once, expanded over a batch once, and each batch
writes its own tokens behind them: what a careful user would write. `--numbers bins` answers with one token, of which median, confidence and
expected error are found on the device. `--plain N` also times N queries by `generate`, each with its own image: what most users would write.
`compare.sh` runs this and the example in turn.
"""

import argparse
import json
import pathlib
import resource
import time

import torch
import transformers
from transformers import DynamicCache
from transformers.cache_utils import DynamicLayer

BEFORE, AFTER = 15, 5
TINY = pathlib.Path(__file__).parents[2] / "assets/sdim-tiny/config.json"


def config(shapes, layers):
    if shapes == "tiny":
        sizes = json.loads(TINY.read_text())
    else:
        hidden, inner, depth, heads, kv, vocab, tied = {
            "3b": (2048, 11008, 36, 16, 2, 151936, True), "7b": (3584, 18944, 28, 28, 4, 152064, False),
        }[shapes]
        sizes = dict(
            hidden_size=hidden, intermediate_size=inner, num_hidden_layers=depth, num_attention_heads=heads,
            num_key_value_heads=kv, vocab_size=vocab, tie_word_embeddings=tied, rms_norm_eps=1e-6, rope_theta=1e6,
            rope_scaling={"type": "mrope", "mrope_section": [16, 24, 24]}, vision_start_token_id=151652,
            vision_end_token_id=151653, image_token_id=151655, video_token_id=151656,
            vision_config={"depth": 32, "hidden_size": 1280, "intermediate_size": 3420, "num_heads": 16,
                           "out_hidden_size": hidden, "patch_size": 14, "spatial_merge_size": 2,
                           "temporal_patch_size": 2, "window_size": 112, "fullatt_block_indexes": [7, 15, 23, 31]},
        )
    if layers:
        sizes["num_hidden_layers"] = layers
    return transformers.Qwen2_5_VLConfig(**sizes)


def build(args):
    torch.set_default_dtype(torch.bfloat16)
    with torch.device("meta"):
        shape = config(args.shapes, args.layers)
        shape._attn_implementation = args.attention
        model = transformers.Qwen2_5_VLForConditionalGeneration(shape).eval()
    rotary = [m for m in model.modules() if "Rotary" in type(m).__name__]
    model = model.to_empty(device=args.device)
    for p in model.parameters():
        p.data.uniform_(-1.7 / p.shape[-1] ** 0.5, 1.7 / p.shape[-1] ** 0.5) if p.dim() > 1 else p.data.fill_(1)
    torch.set_default_dtype(torch.float32)
    vision = shape.vision_config
    for m in rotary:  # buffers that are computed, not loaded
        fresh = type(m)(m.config) if hasattr(m, "config") else type(m)(vision.hidden_size // vision.num_heads // 2)
        for name, buffer in fresh.named_buffers():
            setattr(m, name, buffer.to(args.device))
    model.tie_weights()
    return model


def timed(f, device):
    """What `f` gives, and its seconds, those of the device included."""
    wait = torch.cuda.synchronize if device.type == "cuda" else lambda: None
    wait()
    start = time.perf_counter()
    out = f()
    wait()
    return out, time.perf_counter() - start


class SharedLayer(DynamicLayer):
    """The prompt's keys and values for each item of a batch, with room behind them for what the items add."""

    def __init__(self, prompt, items, room):
        super().__init__()
        self.length = prompt.keys.shape[-2]
        self.kept = [self.expand(x, items, room) for x in (prompt.keys, prompt.values)]
        self.dtype, self.device, self.is_initialized = prompt.keys.dtype, prompt.keys.device, True

    def expand(self, x, items, room):
        _, heads, length, width = x.shape
        kept = x.new_empty(items, heads, length + room, width)
        kept[:, :, :length] = x
        return kept

    def start(self, items):
        """The first `items` of the batch, which have added nothing yet."""
        self.keys, self.values = (x[:items, :, : self.length] for x in self.kept)

    def update(self, keys, values, *args, **kwargs):
        begin, (items, rows) = self.keys.shape[-2], (keys.shape[0], keys.shape[-2])
        for kept, new in zip(self.kept, (keys, values)):
            kept[:items, :, begin : begin + rows] = new
        self.keys, self.values = (x[:items, :, : begin + rows] for x in self.kept)
        return self.keys, self.values


class Numbers:
    """What stands for numbers: eleven tokens of the vocabulary, or as many of their own as there are bins."""

    def __init__(self, model, kind, args):
        table, head = model.model.language_model.embed_tokens.weight, model.lm_head.weight
        self.digits = args.digits if kind == "digits" else None
        if self.digits:
            self.embedding, self.head = table[13:24], head[13:24]
        else:
            scale = 1.7 / table.shape[-1] ** 0.5
            self.embedding = table.new_empty(args.bins, table.shape[-1]).uniform_(-scale, scale)
            self.head = self.embedding if model.lm_head.weight is table else torch.empty_like(self.embedding).uniform_(-scale, scale)
            self.centres = torch.arange(args.bins, device=table.device) + 0.5

    def passes(self):
        return self.digits or 1

    def read(self, hidden):
        """Of digits the likeliest; of bins the median, the probability of 5 % around it, and the expected distance from it, in bins."""
        logits = hidden @ self.head.T
        if self.digits:
            return logits.argmax(-1)
        share = logits.float().softmax(-1)
        below = share.cumsum(-1)
        at = (below < 0.5).sum(-1, keepdim=True).clamp(max=share.shape[-1] - 1)
        own = share.gather(-1, at)
        median = at + ((0.5 - (below.gather(-1, at) - own)) / own).clamp(0, 1)
        off = (self.centres - median).abs()
        near = (share * (off <= 9)).sum(-1)
        return torch.stack([median.squeeze(-1), near, (share * off).sum(-1)], -1)


def arguments():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("--shapes", default="3b", help="3b, 7b or tiny")
    a.add_argument("--layers", type=int, help="decoder layers, if not all of the shapes'")
    a.add_argument("--device", type=torch.device, default="cpu")
    a.add_argument("--attention", default="sdpa", help="sdpa, or flash_attention_2 where flash-attn is installed")
    a.add_argument("--width", type=int, default=644)
    a.add_argument("--height", type=int, default=476)
    a.add_argument("--queries", default="64", help="several numbers, with commas between them, are asked one after the other")
    a.add_argument("--suffix-tokens", type=int, default=1)
    a.add_argument("--numbers", default="digits", help="digits, bins, or both with a comma between them")
    a.add_argument("--digits", type=int, default=5)
    a.add_argument("--bins", type=int, default=1000)
    a.add_argument("--batch", type=int, default=64)
    a.add_argument("--rounds", type=int, default=1, help="the fastest of each stage counts")
    a.add_argument("--plain", type=int, default=0)
    a = a.parse_args()
    a.queries, a.numbers = [int(n) for n in a.queries.split(",")], a.numbers.split(",")
    if not set(a.numbers) <= {"digits", "bins"} or min(a.queries + [a.rounds, a.batch, a.digits, a.bins]) < 1:
        raise SystemExit("--numbers: digits or bins; --queries, --rounds, --batch, --digits and --bins: at least 1 each")
    return a


@torch.inference_mode()
def main():
    a = arguments()
    model, load_s = timed(lambda: build(a), a.device)
    shape = model.config
    image, vision = shape.image_token_id, shape.vision_config
    side = vision.patch_size * vision.spatial_merge_size
    gh, gw = (-(-pixels // side) * vision.spatial_merge_size for pixels in (a.height, a.width))
    grid = torch.tensor([[1, gh, gw]], device=a.device)
    pixels = torch.randn(gh * gw, 3 * vision.temporal_patch_size * vision.patch_size**2, device=a.device).to(torch.bfloat16)
    visual, text = model.model.visual, model.model.language_model
    tokens = gh * gw // vision.spatial_merge_size**2
    ids = torch.tensor([[11] * BEFORE + [image] * tokens + [12] * AFTER], device=a.device)
    length = ids.shape[1]

    # Where the tokens stand and what the image's hold takes no time.
    def prompt():
        cache = DynamicCache()
        position = torch.arange(length, device=a.device).expand(3, 1, length)
        text(inputs_embeds=text.embed_tokens(ids), position_ids=position, past_key_values=cache, use_cache=True)
        return cache

    at = BEFORE + max(gh, gw) // vision.spatial_merge_size + AFTER

    def ask(numbers, cache, n):
        for layer in cache.layers:
            layer.start(n)
        embedded = numbers.embedding[torch.randint(len(numbers.embedding), (n, a.suffix_tokens), device=a.device)]
        start, said = at, None
        for _ in range(numbers.passes()):
            rows = embedded.shape[1]
            position = torch.arange(start, start + rows, device=a.device).expand(3, n, rows)
            out = text(inputs_embeds=embedded, position_ids=position, past_key_values=cache, use_cache=True)
            said = numbers.read(out.last_hidden_state[:, -1])
            if numbers.digits:
                embedded = numbers.embedding[said].unsqueeze(1)
            start += rows
        return said.cpu()

    def all_queries(numbers, prefix, queries):
        batch = min(a.batch, queries)
        cache = DynamicCache()
        cache.layers = [SharedLayer(layer, batch, a.suffix_tokens + numbers.passes()) for layer in prefix.layers]
        return [ask(numbers, cache, min(batch, queries - first)) for first in range(0, queries, batch)]

    def once(numbers, queries):
        _, vision_s = timed(lambda: visual(pixels, grid_thw=grid), a.device)
        prefix, prefill_s = timed(prompt, a.device)
        _, queries_s = timed(lambda: all_queries(numbers, prefix, queries), a.device)
        return vision_s, prefill_s, queries_s

    def measured(kind, queries):
        numbers = Numbers(model, kind, a)
        once(numbers, min(queries, 2 * a.batch))  # loads kernels and sets memory aside
        vision_s, prefill_s, queries_s = (min(s) for s in zip(*(once(numbers, queries) for _ in range(a.rounds))))
        result = {"load_s": load_s, "vision_s": vision_s, "prefill_s": prefill_s, "queries_s": queries_s, "queries": queries,
                  "frame_s": vision_s + prefill_s + queries_s, "queries_per_second": queries / queries_s, "numbers": kind,
                  "tokens_per_query": a.suffix_tokens + numbers.passes() - 1, "prompt_tokens": length, "attention": a.attention,
                  "torch": torch.__version__, "transformers": transformers.__version__, "threads": torch.get_num_threads(),
                  "peak_rss_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024}
        if a.device.type == "cuda":
            free, total = torch.cuda.mem_get_info(a.device)
            result["device_memory_bytes"] = total - free
        return result

    results = [measured(kind, queries) for kind in a.numbers for queries in a.queries]
    if a.plain:
        asked = torch.cat([ids, torch.randint(11, 24, (1, a.suffix_tokens), device=a.device)], 1)
        inputs = {"input_ids": asked, "attention_mask": torch.ones_like(asked), "mm_token_type_ids": (asked == image).int(),
                  "pixel_values": pixels, "image_grid_thw": grid}
        options = transformers.GenerationConfig(max_new_tokens=a.digits, min_new_tokens=a.digits, do_sample=False,
                                                pad_token_id=0, eos_token_id=None)

        def plain():
            for _ in range(a.plain):
                model.generate(**inputs, generation_config=options)

        _, seconds = timed(plain, a.device)
        results[0]["plain_queries_per_second"] = a.plain / seconds
    for result in results:
        print(json.dumps(result), flush=True)


main()
