"""Qwen2.5-VL of `transformers` with what is ours: fusion block, second patch embedding, crops, number tokens."""

import torch
import torch.nn.functional as F
from torch import nn
from torch.utils.checkpoint import checkpoint

from ..model import Fusion
from .records import PIXEL, POSITION

# Id of the first token behind the vocabulary (`src/vlm/qwen2_5/token_table.rs`).
FIRST_ADDED = 1 << 24


class SecondPatchEmbed(nn.Module):
    """F_e2 of Eq. 3a, shaped as the published patch embedding."""

    def __init__(self, vision):
        super().__init__()
        kernel = (vision.temporal_patch_size, vision.patch_size, vision.patch_size)
        self.proj = nn.Conv3d(3, vision.hidden_size, kernel, kernel, bias=False)

    def forward(self, rows):
        return F.linear(rows, self.proj.weight.flatten(1))


class BothPatchEmbeds(nn.Module):
    """E of Eq. 3a, in the place of the published patch embedding: rows hold a patch of I, then the same patch of O."""

    def __init__(self, published, second):
        super().__init__()
        self.published = published
        # Of the adapter, not of the base: kept where no state dict of the base finds it.
        self.second = [second]

    def forward(self, rows):
        image, fused = rows.chunk(2, -1)
        embedded = self.published(image)
        return embedded + self.second[0](fused).to(embedded.dtype)


class NumberRows(nn.Module):
    """Number tokens behind the vocabulary: their embedding, and their head where the base has one of its own."""

    def __init__(self, bins, width, tied):
        super().__init__()
        self.embedding = nn.Parameter(torch.zeros(bins, width))
        self.head = None if tied else nn.Parameter(torch.zeros(bins, width))


class QwenSdim(nn.Module):
    """`base` is a `Qwen2_5_VLForConditionalGeneration`, with LoRA in its layers or without; `self.sdim.state_dict()`, each name below
    `sdim.`, has the names and shapes of an adapter. `numbers` are the ids of the number rows, `image` that of an image token."""

    def __init__(self, base, settings, numbers, image, mean, std):
        super().__init__()
        self.base, self.settings, self.image = base, settings, image
        # In what type the base computes.
        self.compute, self.checkpointing = base.dtype, False
        text, vision = base.config.text_config, base.config.vision_config
        if settings["rope_layout"] != "contiguous":
            raise ValueError("sdim.json, rope_layout: a published checkpoint has contiguous sections")
        if settings.get("wide_glimpse"):
            raise ValueError("sdim.json, wide_glimpse: wide crops are trained with records, by sdim_training.train")
        parts, bins = {}, settings["number"].get("bins")
        if settings["fusion"]:
            parts = {"fusion": Fusion(**settings["fusion"]), "patch_embed": SecondPatchEmbed(vision)}
            tower = base.model.visual
            tower.patch_embed = BothPatchEmbeds(tower.patch_embed, parts["patch_embed"])
        if settings["glimpse"]:
            parts["glimpse"] = nn.Linear(3 * settings["glimpse"] ** 2, text.hidden_size, bias=False)
        if settings.get("number_tokens") == "rows":
            parts["number_tokens"] = NumberRows(bins, text.hidden_size, base.config.tie_word_embeddings)
        self.sdim = nn.ModuleDict(parts)
        self.patch, self.merge = vision.patch_size, vision.spatial_merge_size
        self.still = vision.temporal_patch_size
        for name, value in (("mean", mean), ("std", std)):
            self.register_buffer(name, torch.tensor(value)[:, None, None], persistent=False)
        self.register_buffer("numbers", torch.tensor(numbers), persistent=False)

    def forward(self, batch, measure=False):
        """Logits of the number rows in f32, [supervised, rows], and the statistics that the fusion block's normalisations saw."""
        images = [(rgb.permute(2, 0, 1) * (1 / 255) - self.mean) / self.std for rgb in batch.rgb]
        tokens, seen = self.encode(images, batch.depth, measure)
        embedded = self.embed(batch, images, tokens.to(self.compute))
        hidden = self.base.model.language_model(
            inputs_embeds=embedded,
            position_ids=batch.places[..., POSITION].permute(2, 0, 1),
            attention_mask={"full_attention": visible(batch.group)},
            use_cache=False,
        ).last_hidden_state
        rows = hidden[batch.predict[:, 0], batch.predict[:, 1]]
        return F.linear(rows.float(), self.head().float()), seen

    def layers(self):
        """Those of the base that are computed, cut up and kept one at a time."""
        return [*self.base.model.visual.blocks, *self.base.model.language_model.layers]

    def checkpoint_gradients(self):
        """Keeps the input of each layer alone for the backward pass, which computes the layer again."""
        self.checkpointing = True
        # The older name is left for transformers before 5.24.
        enable = getattr(self.base, "activation_checkpointing_enable", None) or self.base.gradient_checkpointing_enable
        enable({"use_reentrant": False})

    def head(self):
        """One row per number."""
        if "number_tokens" in self.sdim:
            own = self.sdim["number_tokens"]
            return own.embedding if own.head is None else own.head
        return self.base.lm_head.weight[self.numbers]

    def encode(self, images, depths, measure):
        """Image tokens of all frames one after the other (Eq. 1-3)."""
        fused, seen = [None] * len(images), []
        # Frames of one size pass the fusion block together, as its normalisations measure a batch.
        for size in {image.shape for image in images} if "fusion" in self.sdim else ():
            which = [i for i, image in enumerate(images) if image.shape == size]
            stacked = (torch.stack([t[i] for i in which]) for t in (images, depths))
            out, stats = self.fuse(*stacked, measure)
            seen.append(stats)
            for i, o in zip(which, out):
                fused[i] = o
        rows = [
            torch.cat([self.patches(t) for t in pair if t is not None], -1) for pair in zip(images, fused)
        ]
        grids = [[1, image.shape[1] // self.patch, image.shape[2] // self.patch] for image in images]
        grids = torch.tensor(grids, device=images[0].device)
        tokens = self.base.model.visual(torch.cat(rows), grid_thw=grids).pooler_output
        return tokens, [torch.stack(t).mean(0) for t in zip(*seen)]

    def fuse(self, images, depths, measure):
        fusion = self.sdim["fusion"]
        if not (self.checkpointing and self.training):
            return fusion(images, depths[:, None], measure)
        # Its maps have the size of the picture.
        return checkpoint(fusion, images, depths[:, None], measure, use_reentrant=False)

    def patches(self, image):
        """[3, h, w] to the tower's rows: the patches of a merged token follow each other, each is channel, frame, row, column."""
        p, m = self.patch, self.merge
        _, h, w = image.shape
        x = image.view(3, h // (m * p), m, p, w // (m * p), m, p).permute(1, 4, 2, 5, 0, 3, 6)
        return x.reshape(-1, 3, 1, p, p).expand(-1, -1, self.still, -1, -1).flatten(1)

    def embed(self, batch, images, tokens):
        table = self.base.model.language_model.embed_tokens
        added = batch.ids >= FIRST_ADDED
        embedded = table(batch.ids.masked_fill(added, 0)).to(tokens.dtype)
        if "number_tokens" in self.sdim:
            rows = self.sdim["number_tokens"].embedding[batch.ids[added] - FIRST_ADDED]
            embedded = embedded.masked_scatter(added[..., None], rows.to(tokens.dtype))
        embedded = embedded.masked_scatter((batch.ids == self.image)[..., None], tokens)
        if "glimpse" in self.sdim:
            embedded = embedded + self.glimpses(batch, images).to(tokens.dtype)
        return embedded

    def glimpses(self, batch, images):
        """What the crop around its pixel adds to each token, [b, n, width]; 0 where a token stands at none."""
        layer, side = self.sdim["glimpse"], self.settings["glimpse"]
        out = torch.zeros(*batch.ids.shape, layer.weight.shape[0], device=batch.ids.device)
        for row, image in enumerate(images):
            at = batch.places[row, :, PIXEL]
            there = at[:, 0].isfinite()
            crops = crops_of(image, at[there], side)
            out[row, there] = layer(crops)
        return out


def crops_of(image, at, side):
    """The normalised picture around pixels [n, 2] (column, row), bilinear, its border repeated: [n, 3 side side]."""
    height, width = image.shape[1:]
    offset = torch.arange(side, device=at.device) - (side - 1) / 2
    x = ((at[:, 0, None] + offset + 0.5) / width * 2 - 1)[:, None].expand(-1, side, -1)
    y = ((at[:, 1, None] + offset + 0.5) / height * 2 - 1)[..., None].expand(-1, -1, side)
    grid = torch.stack([x, y], -1).view(1, -1, side * side, 2)
    out = F.grid_sample(image[None], grid, padding_mode="border", align_corners=False)
    return out[0].transpose(0, 1).flatten(1)


def visible(group):
    """Who sees whom, [b, 1, n, n]: a token sees what comes before it in the prompt and in its own question, and itself."""
    n = group.shape[1]
    earlier = torch.ones(n, n, dtype=torch.bool, device=group.device).tril()
    prompt, own = (group == 0)[:, None], group[:, :, None] == group[:, None]
    itself = torch.eye(n, dtype=torch.bool, device=group.device)
    return (earlier & (prompt & (group >= 0)[..., None] | own) | itself)[:, None]
