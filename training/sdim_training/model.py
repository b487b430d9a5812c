"""sdim's small models in PyTorch: tensor for tensor those of a checkpoint, frames of one size in batches.

What the crate derives from weights when it loads them (the patch kernels summed over their frames, number rows as the output
head) is derived here in every forward pass, so that what is trained is what will be loaded.
"""

import json
import math
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

BN_EPS, LEAKY_SLOPE, VISION_EPS = 1e-5, 0.01, 1e-6
# Of wide crops (`src/model/wide_glimpse.rs`): the side of a cell, and by what differences of logarithms are multiplied and limited.
CELL, STEEP = 4, 4.0
# Time of measurements and of questions after the image's own (`src/query/prompt.rs`).
TOLD_TIME, ASKED_TIME = 1.0, 2.0


class Batch(NamedTuple):
    """`b` frames, each with room for `p` measurements in the prompt and `q` questions. Numbers are in number units."""

    rgb: Tensor  # u8 [b, h, w, 3]
    depth: Tensor  # f32 [b, h, w]: what the fusion block sees of measurements at their pixels, 0 elsewhere
    interpolated: Tensor  # f32 [b, h / 4, w / 4]: what interpolation gives at the middle of each cell
    told_id: Tensor  # i64 [b, p]
    told_at: Tensor  # f32 [b, p, 2]: column and row
    told_count: Tensor  # i64 [b]
    asked_id: Tensor  # i64 [b, q]
    asked_at: Tensor  # f32 [b, q, 2]
    hint: Tensor  # f32 [b, q]
    value: Tensor  # f32 [b, q]: the true answers
    scale: Tensor  # f32 [b]: what errors are counted in


class Bins:
    """Where numbers lie, from `number` of sdim.json: bin k covers positions k to k + 1 (`src/query/bins.rs`)."""

    def __init__(self, number):
        self.bins, self.ratio = number["bins"], number["kind"] == "log_bins"
        self.lowest = number["lowest"] if self.ratio else 0.0
        # Of a bin: in number units, or of the number's logarithm.
        self.width = (math.log(number["highest"] / self.lowest) if self.ratio else number["range"]) / self.bins

    def number(self, position):
        """The number at a position among the bins."""
        return self.lowest * (position * self.width).exp() if self.ratio else position * self.width

    def position(self, number):
        """The position of a number, those out of range at the ends."""
        position = (number.clamp(min=1e-30) / self.lowest).log() if self.ratio else number
        return (position / self.width).clamp(0, self.bins)

    def middles(self, device=None):
        """Positions of the middle of each bin."""
        return torch.arange(self.bins, device=device) + 0.5


class Config(Bins):
    """Sizes and ways of asking, from the JSON files of a checkpoint directory."""

    def __init__(self, directory):
        def read(name):
            return json.loads((Path(directory) / name).read_text())

        self.text, self.sdim, image = read("config.json"), read("sdim.json"), read("preprocessor_config.json")
        self.vision, number, fusion = self.text["vision_config"], self.sdim["number"], self.sdim["fusion"]
        wanted = {
            "tie_word_embeddings": self.text["tie_word_embeddings"] is True,
            "sdim.json, number": number["kind"] in ("bins", "log_bins"),
            # Rows behind the vocabulary are for published checkpoints, which are not trained here.
            "sdim.json, number_tokens": self.sdim.get("number_tokens", "vocabulary") == "vocabulary",
            "sdim.json, pixel_reference": self.sdim["pixel_reference"]["kind"] == "pointer",
            "sdim.json, hint": self.sdim["hint"] == "linear",
            "sdim.json, fusion": fusion is not None,
            "sdim.json, template": self.sdim["template"]["query"] == "{pixel}",
        }
        for key, fits in wanted.items():
            if not fits:
                raise ValueError(f"{directory}: {key} is not the way of asking that can be trained here")
        self.fusion = (fusion["branch"], fusion["high"], fusion["low"])
        super().__init__(number)
        self.glimpse, self.wide_glimpse = self.sdim["glimpse"], self.sdim.get("wide_glimpse")
        self.scale = self.sdim["position_scale"]
        self.mean, self.std = image["image_mean"], image["image_std"]
        added = {t["content"]: t["id"] for t in read("tokenizer.json")["added_tokens"]}
        template = self.sdim["template"]
        self.before, self.after = ([added[template[key]]] for key in ("before_image", "after_image"))
        self.first_number = added["<|d0|>"]
        if added[f"<|d{self.bins - 1}|>"] != self.first_number + self.bins - 1:
            raise ValueError(f"{directory}: number tokens do not follow each other")


class RmsNorm(nn.Module):
    def __init__(self, size, eps):
        super().__init__()
        self.weight, self.eps = nn.Parameter(torch.ones(size)), eps

    def forward(self, x):
        return F.rms_norm(x.float(), x.shape[-1:], self.weight, self.eps).to(x.dtype)


def turned(x, cos, sin):
    """Rotary positions: `x` is [..., heads, d], the tables are [..., d / 2]."""
    first, second = x.float().chunk(2, -1)
    cos, sin = cos.unsqueeze(-2), sin.unsqueeze(-2)
    return torch.cat([first * cos - second * sin, second * cos + first * sin], -1).to(x.dtype)


class Mlp(nn.Module):
    def __init__(self, size, inner, bias):
        super().__init__()
        self.gate_proj, self.up_proj = nn.Linear(size, inner, bias), nn.Linear(size, inner, bias)
        self.down_proj = nn.Linear(inner, size, bias)

    def forward(self, x):
        return self.down_proj(F.silu(self.gate_proj(x)) * self.up_proj(x))


class BatchNorm(nn.Module):
    """Statistics of the batch while they are measured, the running ones afterwards. Who trains updates the running ones."""

    def __init__(self, size):
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.ones(size)), nn.Parameter(torch.zeros(size))
        self.register_buffer("running_mean", torch.zeros(size))
        self.register_buffer("running_var", torch.ones(size))

    def forward(self, x, seen):
        x = x.float()
        mean, var = self.running_mean, self.running_var
        if seen is not None:
            var, mean = torch.var_mean(x, (0, 2, 3), correction=0)
            seen += [mean.detach(), var.detach()]
        scale = self.weight * (var + BN_EPS).rsqrt()
        return x * scale[:, None, None] + (self.bias - mean * scale)[:, None, None]


class ConvBnAct(nn.Module):
    def __init__(self, inputs, outputs):
        super().__init__()
        self.conv, self.bn = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False), BatchNorm(outputs)

    def forward(self, x, seen):
        return F.leaky_relu(self.bn(self.conv(x), seen), LEAKY_SLOPE)


class Fusion(nn.Module):
    """Eq. 1 and 2 of the paper: image and measurements to O."""

    def __init__(self, branch, high, low):
        super().__init__()
        self.rgb, self.depth = ConvBnAct(3, branch), ConvBnAct(1, branch)
        self.high, self.low = ConvBnAct(2 * branch, high), ConvBnAct(high, low)
        self.out = nn.Conv2d(low, 3, 3, padding=1)

    def forward(self, image, depth, measure):
        """O, and the statistics that each normalisation saw, if they are to be measured: means and variances in turn."""
        seen = [] if measure else None
        x = torch.cat([self.rgb(image, seen), self.depth(depth, seen)], 1)
        return self.out(self.low(self.high(x, seen), seen)), seen or []

    def running(self):
        """The running statistics in the order of what `forward` reports."""
        norms = (self.rgb.bn, self.depth.bn, self.high.bn, self.low.bn)
        return [t for bn in norms for t in (bn.running_mean, bn.running_var)]


class VisionBlock(nn.Module):
    def __init__(self, c, full):
        super().__init__()
        d, self.heads, self.full = c["hidden_size"], c["num_heads"], full
        # In patches; windows are counted in merged tokens.
        merge = c["spatial_merge_size"]
        self.side = c["window_size"] // merge // c["patch_size"] * merge
        self.norm1, self.norm2 = RmsNorm(d, VISION_EPS), RmsNorm(d, VISION_EPS)
        self.attn = nn.ModuleDict({"qkv": nn.Linear(d, 3 * d), "proj": nn.Linear(d, d)})
        self.mlp = Mlp(d, c["intermediate_size"], True)

    def forward(self, x, cos, sin):
        b, rows, cols, d = x.shape
        q, k, v = self.attn["qkv"](self.norm1(x)).view(b, rows, cols, 3, self.heads, -1).unbind(3)
        q, k = turned(q, cos, sin), turned(k, cos, sin)
        if self.full:
            q, k, v = (t.flatten(1, 2).transpose(1, 2) for t in (q, k, v))
            y = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(b, rows, cols, d)
        else:
            y = self.windowed(q, k, v).reshape(b, rows, cols, d)
        x = x + self.attn["proj"](y)
        return x + self.mlp(self.norm2(x))

    def windowed(self, q, k, v):
        """Attention within windows; those at the right and bottom edges are smaller."""
        b, rows, cols, heads, hd = q.shape
        s, below, right = self.side, -rows % self.side, -cols % self.side
        high, wide = (rows + below) // s, (cols + right) // s

        def cut(t):
            t = F.pad(t, (0, 0, 0, 0, 0, right, 0, below))
            return t.view(b, high, s, wide, s, heads, hd).permute(0, 1, 3, 5, 2, 4, 6).reshape(-1, heads, s * s, hd)

        mask = None
        if below or right:
            inside = F.pad(torch.ones(rows, cols, dtype=torch.bool, device=q.device), (0, right, 0, below))
            inside = inside.view(high, s, wide, s).transpose(1, 2).reshape(1, high * wide, 1, 1, s * s)
            mask = inside.expand(b, -1, -1, -1, -1).flatten(0, 1)
        y = F.scaled_dot_product_attention(cut(q), cut(k), cut(v), attn_mask=mask)
        y = y.view(b, high, wide, heads, s, s, hd).permute(0, 1, 4, 2, 5, 3, 6)
        return y.reshape(b, rows + below, cols + right, heads, hd)[:, :rows, :cols]


class PatchEmbed(nn.Module):
    def __init__(self, c):
        super().__init__()
        kernel = (c["temporal_patch_size"], c["patch_size"], c["patch_size"])
        self.proj = nn.Conv3d(3, c["hidden_size"], kernel, bias=False)

    def forward(self, image):
        """A still image is the same in each frame, so the kernel is summed over them: [b, 3, h, w] to [b, d, rows, cols]."""
        return F.conv2d(image, self.proj.weight.sum(2), stride=self.proj.weight.shape[-1])


class VisionTower(nn.Module):
    def __init__(self, c):
        super().__init__()
        d, self.merge = c["hidden_size"], c["spatial_merge_size"]
        wide = d * self.merge**2
        self.patch_embed = PatchEmbed(c)
        self.blocks = nn.ModuleList(VisionBlock(c, i in c["fullatt_block_indexes"]) for i in range(c["depth"]))
        mlp = nn.ModuleList([nn.Linear(wide, wide), nn.GELU(), nn.Linear(wide, c["out_hidden_size"])])
        self.merger = nn.ModuleDict({"ln_q": RmsNorm(d, VISION_EPS), "mlp": mlp})
        half = d // c["num_heads"] // 2
        self.register_buffer("inverse", 10000.0 ** -(torch.arange(0, half, 2) / half), persistent=False)

    def forward(self, embedded):
        """[b, d, rows, cols] to merged tokens [b, rows, cols, width]."""
        x = embedded.permute(0, 2, 3, 1)
        b, rows, cols, _ = x.shape
        y, z = (torch.arange(n, device=x.device)[:, None] * self.inverse for n in (rows, cols))
        angles = torch.cat([y[:, None].expand(-1, cols, -1), z[None].expand(rows, -1, -1)], -1)
        cos, sin = angles.cos(), angles.sin()
        for block in self.blocks:
            x = block(x, cos, sin)
        m = self.merge
        x = self.merger["ln_q"](x).view(b, rows // m, m, cols // m, m, -1).transpose(2, 3).flatten(3)
        for layer in self.merger["mlp"]:
            x = layer(x)
        return x


class DecoderLayer(nn.Module):
    def __init__(self, c):
        super().__init__()
        d, self.heads, self.kv_heads = c["hidden_size"], c["num_attention_heads"], c["num_key_value_heads"]
        kv = d // self.heads * self.kv_heads
        self.input_layernorm, self.post_attention_layernorm = (RmsNorm(d, c["rms_norm_eps"]) for _ in range(2))
        self.self_attn = nn.ModuleDict({"q_proj": nn.Linear(d, d), "k_proj": nn.Linear(d, kv)})
        self.self_attn.update({"v_proj": nn.Linear(d, kv), "o_proj": nn.Linear(d, d, bias=False)})
        self.mlp = Mlp(d, c["intermediate_size"], False)

    def forward(self, x, cos, sin, prefix, visible):
        """The first `prefix` tokens are one causal sequence; each later one sees what `visible` [b, 1, later, all] says."""
        b, t, _ = x.shape
        y, a = self.input_layernorm(x), self.self_attn
        q, k, v = (a[f"{n}_proj"](y).view(b, t, h, -1) for n, h in zip("qkv", (self.heads, *2 * (self.kv_heads,))))
        q, k = turned(q, cos, sin).transpose(1, 2), turned(k, cos, sin).transpose(1, 2)
        k, v = (t.repeat_interleave(self.heads // self.kv_heads, 1) for t in (k, v.transpose(1, 2)))
        first = F.scaled_dot_product_attention(q[:, :, :prefix], k[:, :, :prefix], v[:, :, :prefix], is_causal=True)
        later = F.scaled_dot_product_attention(q[:, :, prefix:], k, v, attn_mask=visible)
        x = x + a["o_proj"](torch.cat([first, later], 2).transpose(1, 2).flatten(2))
        return x + self.mlp(self.post_attention_layernorm(x))


class Decoder(nn.Module):
    def __init__(self, c):
        super().__init__()
        self.embed_tokens = nn.Embedding(c["vocab_size"], c["hidden_size"])
        self.layers = nn.ModuleList(DecoderLayer(c) for _ in range(c["num_hidden_layers"]))
        self.norm = RmsNorm(c["hidden_size"], c["rms_norm_eps"])


class SdimModel(nn.Module):
    """`state_dict()` has exactly the names and shapes of a checkpoint."""

    def __init__(self, config):
        super().__init__()
        self.config, c = config, config.text
        self.model, self.visual = Decoder(c), VisionTower(config.vision)
        parts = {"fusion": Fusion(*config.fusion), "patch_embed": PatchEmbed(config.vision)}
        if config.glimpse:
            parts["glimpse"] = nn.Linear(3 * config.glimpse**2, c["hidden_size"], bias=False)
        if config.wide_glimpse:
            layers = {"up": nn.Linear(8 * config.glimpse**2, config.wide_glimpse)}
            layers |= {"down": nn.Linear(config.wide_glimpse, c["hidden_size"], bias=False)}
            parts["wide_glimpse"] = nn.ModuleDict(layers)
        self.sdim = nn.ModuleDict(parts)
        half = c["hidden_size"] // c["num_attention_heads"] // 2
        t, h, w = c["rope_scaling"]["mrope_section"]
        if config.sdim["rope_layout"] == "interleaved":
            axis = [1 if i % 3 == 1 and i < 3 * h else 2 if i % 3 == 2 and i < 3 * w else 0 for i in range(half)]
        else:
            axis = [0] * t + [1] * h + [2] * w
        constants = {
            "inverse": c["rope_theta"] ** -(torch.arange(half) / half),
            "axis": torch.tensor(axis),
            "mean": torch.tensor(config.mean)[:, None, None],
            "std": torch.tensor(config.std)[:, None, None],
            "words": torch.tensor(config.before + config.after),
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, batch, measure=False):
        """Logits [b, q, bins] in f32, and the statistics that the fusion block's normalisations saw."""
        image = (batch.rgb.permute(0, 3, 1, 2) * (1 / 255) - self.mean) / self.std
        fused, seen = self.sdim["fusion"](image, batch.depth[:, None], measure)
        return self.read(image, fused, batch), seen

    def read(self, image, fused, batch):
        tokens = self.visual(self.visual.patch_embed(image) + self.sdim["patch_embed"](fused))
        b, rows, cols, d = tokens.shape
        at = torch.cat([batch.told_at, batch.asked_at], 1)
        spoken = self.model.embed_tokens(torch.cat([batch.told_id, batch.asked_id], 1))
        if self.config.glimpse:
            crops = self.crops(image, at)
            spoken = spoken + self.sdim["glimpse"](crops)
            if self.config.wide_glimpse:
                wide = self.sdim["wide_glimpse"]
                spoken = spoken + wide["down"](F.relu(wide["up"](torch.cat([crops, self.wide_crops(image, batch)], -1))))
        words = self.model.embed_tokens(self.words).expand(b, -1, -1).to(tokens.dtype)
        x = torch.cat([words[:, :1], tokens.flatten(1, 2), words[:, 1:], spoken.to(tokens.dtype)], 1)
        cos, sin = self.positions(image, rows, cols, at, batch.told_id.shape[1])
        asked = batch.asked_id.shape[1]
        prefix, visible = x.shape[1] - asked, self.visible(batch, rows * cols + 2)
        for layer in self.model.layers:
            x = layer(x, cos, sin, prefix, visible)
        first = self.config.first_number
        head = self.model.embed_tokens.weight[first : first + self.config.bins]
        with torch.autocast(x.device.type, enabled=False):
            return F.linear(self.model.norm(x[:, prefix:].float()), head)

    def visible(self, batch, before):
        """Who sees whom: a question sees the prefix without its empty places, and itself."""
        (b, told), asked, device = batch.told_id.shape, batch.asked_id.shape[1], batch.told_id.device
        there = torch.arange(told, device=device) < batch.told_count[:, None]
        there = torch.cat([torch.ones(b, before, dtype=torch.bool, device=device), there], 1)
        own = torch.eye(asked, dtype=torch.bool, device=device).expand(b, -1, -1)
        return torch.cat([there[:, None].expand(-1, asked, -1), own], 2)[:, None]

    def positions(self, image, rows, cols, at, told):
        """Cosines and sines of M-RoPE, [b, tokens, d / 2]: words before, image, words after, then pixels."""
        b, scale, device = at.shape[0], self.config.scale, at.device
        y, x = torch.meshgrid(*(1 + torch.arange(n, device=device) * scale for n in (rows, cols)), indexing="ij")
        grid = torch.stack([torch.ones_like(y), y, x], -1).flatten(0, 1)
        word = torch.ones(1, 3, device=device)
        opening = torch.cat([word * 0, grid, word * (1 + max(rows, cols) * scale)]).expand(b, -1, -1)
        height, width = image.shape[2:]
        size = torch.tensor([width, height], device=device)
        cells = torch.tensor([cols, rows], device=device)
        place = (1 + ((at + 0.5) / size * cells - 0.5) * scale).flip(-1)
        time = torch.full_like(place[..., :1], 1 + TOLD_TIME)
        time[:, told:] = 1 + ASKED_TIME
        pixels = torch.cat([time, place], -1)
        angles = torch.cat([opening, pixels], 1)[..., self.axis] * self.inverse
        return angles.cos(), angles.sin()

    def wide_crops(self, image, batch):
        """Cells around pixels: mean colour, interpolated depth relative to what the token states, measured: [b, n, 5 side side]."""
        depth = batch.interpolated.log()[:, None]
        measured = F.max_pool2d((batch.depth != 0).float()[:, None], CELL)
        cells = torch.cat([F.avg_pool2d(image, CELL), depth, measured], 1)
        at = (torch.cat([batch.told_at, batch.asked_at], 1) + 0.5) / CELL - 0.5
        stated = torch.cat([batch.told_id, batch.asked_id], 1) - self.config.first_number + 0.5
        stated = self.config.number(stated.clamp(min=0.5)).log()
        crops = self.crops(cells, at).unflatten(2, (5, -1))
        depth = ((crops[:, :, 3:4] - stated[..., None, None]) * STEEP).clamp(-STEEP, STEEP)
        return torch.cat([crops[:, :, :3], depth, crops[:, :, 4:]], 2).flatten(2)

    def crops(self, image, at):
        """The normalised picture around pixels, bilinear, its border repeated: [b, n, channels side side]."""
        side, (b, n, _) = self.config.glimpse, at.shape
        height, width = image.shape[2:]
        offset = torch.arange(side, device=at.device) - (side - 1) / 2
        x = ((at[..., 0, None] + offset + 0.5) / width * 2 - 1)[:, :, None].expand(-1, -1, side, -1)
        y = ((at[..., 1, None] + offset + 0.5) / height * 2 - 1)[..., None].expand(-1, -1, -1, side)
        grid = torch.stack([x, y], -1).view(b, n, side * side, 2)
        out = F.grid_sample(image.float(), grid, padding_mode="border", align_corners=False)
        return out.transpose(1, 2).flatten(2)
