"""Trainings by train.py in the process of a test, and what they leave."""

from pathlib import Path

import torch

import train


def train_on(scene: Path, out: Path, *words: object) -> dict[int, bytes]:
    """Train; the PLYs in the output folder by iteration."""
    train.main([*map(str, ("-s", scene, "-m", out, *words))])
    return {int(ply.parent.name[10:]): ply.read_bytes() for ply in out.glob("point_cloud/*/*.ply")}


def leaves(value: object) -> list:
    """The numbers of a checkpoint, one after the other; tensors as shape and bytes."""
    if torch.is_tensor(value):
        return [(value.shape, value.detach().cpu().numpy().tobytes())]
    if isinstance(value, dict):
        return [leaf for pair in value.items() for leaf in (pair[0], *leaves(pair[1]))]
    if isinstance(value, list | tuple):
        return [leaf for item in value for leaf in leaves(item)]
    return [value]


def whole_result(out: Path, iteration: int) -> dict[str, bytes | list]:
    """The bytes of the PLY of an iteration, and the leaves of its checkpoint."""
    checkpoint = torch.load(out / f"chkpnt{iteration}.pth", weights_only=False)
    ply = out / f"point_cloud/iteration_{iteration}/point_cloud.ply"
    return {"ply": ply.read_bytes(), "checkpoint": leaves(checkpoint)}
