"""What is trained, under the names of an adapter (`src/model/adapter.rs`): LoRA in the base's layers, and all of `sdim.*`."""

import json
import shutil
from pathlib import Path

import torch
from peft import LoraConfig, inject_adapter_in_model
from safetensors.torch import load_file, save_file
from torch import nn

from ..checkpoint import whole

SETTINGS, TENSORS = "sdim.json", "sdim.safetensors"
# Spread of a number row around the digits' mean, in that of the digits (`src/model/number_rows.rs`).
ROW_NOISE = 0.1


def published(name):
    """A parameter's name in a published checkpoint or an adapter, from that in memory."""
    for inner in (".base_layer", ".published", ".default"):
        name = name.replace(inner, "")
    if name.startswith("model.visual."):
        return name.removeprefix("model.")
    return "model." + name.removeprefix("model.language_model.") if name.startswith("model.language_model.") else name


def read_settings(directory):
    settings = json.loads((Path(directory) / SETTINGS).read_text())
    if "preset" in settings or isinstance(settings.get("template"), str):
        raise ValueError(f"{directory}/{SETTINGS}: presets are the crate's to spell out (`number_tokens`, `Settings::to_json`)")
    return settings


def asking(settings):
    """How a checkpoint is asked, whatever LoRA it has. The crate leaves out where number tokens are if the vocabulary has them."""
    return {"number_tokens": "vocabulary"} | {k: v for k, v in settings.items() if k != "lora"}


def add_lora(base, lora):
    """Puts factors beside the layers that `targets` name, as `LoraConfig::covers` does; everything else is frozen."""
    base.requires_grad_(False)
    if lora is None:
        return

    def covered(name):
        return any(name == t or name.endswith(f".{t}") for t in lora["targets"])

    layers = [n for n, m in base.named_modules() if isinstance(m, nn.Linear) and covered(published(n))]
    for target in lora["targets"]:
        if not any(published(n).endswith(target) for n in layers):
            raise ValueError(f"{SETTINGS}, lora.targets: {target} is the last part of no linear layer's name")
    inject_adapter_in_model(LoraConfig(r=lora["rank"], lora_alpha=lora["alpha"], target_modules=layers), base)
    for name, parameter in base.named_parameters():
        if ".lora_" in name:
            # Small steps would be lost in bf16.
            parameter.data = parameter.data.float()


def initial(model, digits, seed):
    """Values that training starts from, so that a fresh adapter's fusion block changes nothing (`src/model/initial.rs`). `digits` are
    the ids of 0 to 9."""
    random = torch.Generator().manual_seed(seed)

    def normal(shape, std):
        return torch.randn(shape, generator=random) * std

    with torch.no_grad():
        for name, tensor in model.sdim.named_parameters():
            if name.startswith("number_tokens"):
                continue
            if name.endswith("bias") or name.startswith(("fusion.depth.conv", "fusion.out", "glimpse")):
                tensor.zero_()
            elif tensor.dim() == 1:
                tensor.fill_(1.0)
            else:
                gain = 2.0 if name.startswith("fusion") else 1.0
                tensor.copy_(normal(tensor.shape, (gain / tensor[0].numel()) ** 0.5))
        if "number_tokens" in model.sdim:
            own, embedding = model.sdim["number_tokens"], model.base.model.language_model.embed_tokens
            for rows, table in ((own.embedding, embedding), (own.head, model.base.lm_head)):
                if rows is not None:
                    known = table.weight[digits].float().cpu()
                    spread = (known - known.mean(0)).square().mean().sqrt()
                    rows.copy_(known.mean(0) + normal(rows.shape, ROW_NOISE * spread))


def load(model, directory):
    """The tensors of an adapter directory, all of them and no others. An adapter without LoRA may be tuned with it."""
    own = trained(model, plain=False)
    found = load_file(Path(directory) / TENSORS)
    lora = {name for name in own if ".lora_" in name}
    missing = own.keys() - found.keys() - (set() if lora & found.keys() else lora)
    if missing or found.keys() - own.keys():
        other = sorted(missing | (found.keys() - own.keys()))
        raise ValueError(f"{directory}/{TENSORS}: not the tensors of its {SETTINGS}: {', '.join(other[:8])}")
    with torch.no_grad():
        for name, tensor in found.items():
            own[name].copy_(tensor)


def trained(model, plain=True):
    """Name to tensor of what an adapter holds; `plain`: copies in f32 on the CPU, gathered from all ranks."""
    factors = {published(n): p for n, p in model.base.named_parameters() if ".lora_" in n}
    tensors = factors | {f"sdim.{n}": t for n, t in model.sdim.state_dict(keep_vars=True).items()}
    return {name: gathered(t, torch.float32) if plain else t for name, t in tensors.items()}


def gathered(tensor, dtype):
    """A copy on the CPU; every rank has to call it for a tensor of which it holds a part."""
    tensor = tensor.detach()
    tensor = tensor.full_tensor() if hasattr(tensor, "full_tensor") else tensor
    return tensor.to("cpu", dtype).clone().contiguous()


def save(tensors, settings, directory):
    """An adapter directory, each file whole or not at all."""
    directory.mkdir(parents=True, exist_ok=True)
    whole(directory / TENSORS, lambda part: save_file(tensors, part))
    whole(directory / SETTINGS, lambda part: part.write_text(json.dumps(settings, indent=2) + "\n"))


def base_tensors(model):
    """Name to tensor of the base as it is published, in bf16 on the CPU, gathered from all ranks."""
    tied = model.base.config.tie_word_embeddings
    named = ((published(n), p) for n, p in model.base.named_parameters() if ".lora_" not in n)
    return {n: gathered(p, torch.bfloat16) for n, p in named if not (tied and n == "lm_head.weight")}


def save_base(tensors, files, directory):
    """A whole checkpoint: these tensors with the JSON files of the directory `files`."""
    directory.mkdir(parents=True, exist_ok=True)
    for path in Path(files).glob("*.json"):
        if not path.name.endswith(".index.json") and path.name != SETTINGS:
            shutil.copyfile(path, directory / path.name)
    whole(directory / "model.safetensors", lambda part: save_file(tensors, part, {"format": "pt"}))


def digit_ids(directory):
    """Ids of 0 to 9, which are tokens of their own in Qwen2.5's vocabulary."""
    vocabulary = json.loads((Path(directory) / "tokenizer.json").read_text())["model"]["vocab"]
    return [vocabulary[str(d)] for d in range(10)]
