"""One model on several GPUs and machines: FSDP of the base, equal copies of the few tensors that are ours."""

import json
import os
import shutil

import torch
import torch.distributed as dist
import torch.distributed.checkpoint as dcp
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import MixedPrecisionPolicy, fully_shard

STATE, COUNTS = "state", "counts.json"


def in_turns(make):
    """Lets the processes of a machine do something one after the other, so that its memory holds one whole base at a time."""
    if not dist.is_initialized():
        return make()
    made = None
    for turn in range(int(os.environ.get("LOCAL_WORLD_SIZE", 1))):
        if turn == int(os.environ.get("LOCAL_RANK", 0)):
            made = make()
        dist.barrier()
    return made


def shard(model, mesh):
    """Cuts the base up over the ranks. Layers compute in the model's own type, and gradients are summed in f32."""
    policy = MixedPrecisionPolicy(param_dtype=model.compute, reduce_dtype=torch.float32, cast_forward_inputs=False)
    for layer in model.layers():
        fully_shard(layer, mesh=mesh, mp_policy=policy)
    return fully_shard(model, mesh=mesh, mp_policy=policy, ignored_params=set(model.sdim.parameters()))


def mesh_of(device, world):
    return init_device_mesh(device.type, (world,))


def local(tensor):
    return tensor.to_local() if hasattr(tensor, "to_local") else tensor


def average_own(model, world):
    """The gradients of what every rank has a copy of, averaged; FSDP does it for the rest."""
    own = [p.grad for p in model.sdim.parameters() if p.grad is not None]
    if world > 1 and own:
        flat = torch.cat([g.flatten() for g in own])
        dist.all_reduce(flat)
        for gradient, part in zip(own, (flat / world).split([g.numel() for g in own])):
            gradient.copy_(part.view_as(gradient))


def mean_over_ranks(values, world):
    """Of a list of tensors."""
    if world > 1 and values:
        flat = torch.cat([v.flatten() for v in values])
        dist.all_reduce(flat)
        return [part.view_as(v) for part, v in zip((flat / world).split([v.numel() for v in values]), values)]
    return values


def clip(parameters, most, world):
    """Scales gradients down to a norm of at most `most`; returns what it was, the same on all ranks."""
    with_gradient = [p for p in parameters if p.grad is not None]
    squares = torch.zeros(2, device=with_gradient[0].device if with_gradient else "cpu")
    for p in with_gradient:
        cut = hasattr(p.grad, "to_local")
        squares[int(cut)] += local(p.grad).float().square().sum()
    if world > 1:
        # A copy is the same everywhere; of what is cut up every rank has a part.
        dist.all_reduce(squares[1:])
    norm = squares.sum().sqrt()
    scale = (most / (norm + 1e-6)).clamp(max=1.0)
    for p in with_gradient:
        local(p.grad).mul_(scale)
    return norm.item()


def tensors_of(named, optimiser):
    """Weights and moments by name, in place; statistics have no moments."""
    parts = {f"weights.{n}": t.detach() for n, t in named.items()}
    for n, p in named.items():
        if p.requires_grad:
            if not optimiser.state.get(p):
                # As the first step would make it, so that there is something to load into.
                moments = {kind: torch.zeros_like(p) for kind in ("exp_avg", "exp_avg_sq")}
                optimiser.state[p] = {"step": torch.tensor(0.0)} | moments
            parts |= {f"{kind}.{n}": optimiser.state[p][kind] for kind in ("exp_avg", "exp_avg_sq")}
    return parts


def save_state(directory, named, optimiser, counts):
    """What a run goes on from, in pieces that any number of ranks can read."""
    part, target = directory / f"{STATE}.part", directory / STATE
    first = not dist.is_initialized() or dist.get_rank() == 0
    if first:
        shutil.rmtree(part, ignore_errors=True)
    if dist.is_initialized():
        dist.barrier()
    dcp.save(tensors_of(named, optimiser), checkpoint_id=part, no_dist=not dist.is_initialized())
    if first:
        (part / COUNTS).write_text(json.dumps(counts))
        shutil.rmtree(target, ignore_errors=True)
        part.rename(target)
    if dist.is_initialized():
        dist.barrier()


def load_state(directory, named, optimiser):
    """Fills weights and moments; returns the counts."""
    target = directory / STATE
    counts = json.loads((target / COUNTS).read_text())
    dcp.load(tensors_of(named, optimiser), checkpoint_id=target, no_dist=not dist.is_initialized())
    for p in optimiser.state:
        optimiser.state[p]["step"].fill_(float(counts["updates"]))
    return counts
