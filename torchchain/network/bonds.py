"""Rules for the bonds and the box of a network."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks


def checked_box(value: Any, positions: Tensor) -> Tensor:
    """Periods (dimension,) or the vectors of the cell as rows (dimension, dimension), like the positions."""
    d = positions.shape[1]
    box = _as_tensor("box", value, "None or real numbers").to(positions)
    if box.ndim == 0:
        raise checks.FieldTypeError(f"box must be None or have shape ({d},) or ({d}, {d}), got {value!r}")
    if tuple(box.shape) not in ((d,), (d, d)):
        raise checks.fail("box", f"have shape ({d},) or ({d}, {d})", box)
    if box.ndim == 1:
        checks.first_bad("box", "be positive", box, ~(box > 0), "direction")
        return box
    checks.finite("box", box)
    volume = torch.linalg.det(box).abs().item()
    if not volume > 1e-12 * box.norm(dim=-1).prod().item():
        raise checks.fail("box", "have rows that span a volume", f"a volume of {volume:g}")
    return box


def checked_bonds(
    value: Any, images: Any, n: int, n_anchors: int, positions: Tensor, boxed: bool
) -> tuple[Tensor, Tensor | None]:
    """Bonds (bond, 2) between particles 0 to n - 1 and anchors from n on, and their images (bond, dimension) or None."""
    bonds = _as_tensor("bonds", value, "pairs of integers")
    if bonds.numel() == 0:
        return torch.zeros((0, 2), dtype=torch.int64, device=positions.device), images
    if bonds.is_floating_point() or bonds.is_complex() or bonds.dtype == torch.bool:
        raise checks.FieldTypeError(f"bonds must be integers, got {bonds.dtype}")
    if bonds.ndim != 2 or bonds.shape[1] != 2:
        raise checks.fail("bonds", "have shape (bond, 2)", bonds)
    bonds = bonds.to(positions.device, torch.int64)
    top = n + n_anchors
    more = f" and anchors {n} to {top - 1}" if top > n else ""
    _refuse(bonds, ((bonds < 0) | (bonds >= top)).any(-1), f"join particles 0 to {n - 1}{more}")
    _refuse(bonds, (bonds >= n).all(-1), "have a particle at one end at least", "two anchors, ")
    bad = bonds[:, 0] == bonds[:, 1]
    if images is not None:
        images, shape = torch.as_tensor(images).to(bonds.device), (len(bonds), positions.shape[1])
        if images.is_floating_point() or tuple(images.shape) != shape:
            raise checks.fail("images", f"be integers of shape {shape}", f"{images.dtype}, shape {tuple(images.shape)}")
        images = images.to(torch.int64)
        if not boxed and bool((images != 0).any()):
            raise checks.fail("images", "be zero without a box", "others")
        bad &= (images == 0).all(-1)
    _refuse(bonds, bad, "join two different particles")
    return bonds, images


def moved(images: Tensor, box: Tensor) -> Tensor:
    """How far copies in the cells ``images`` (*any, dimension) are from their particles, (*any, dimension)."""
    return torch.where(images == 0, 0.0, images * box) if box.ndim == 1 else images.to(box) @ box


def check_shorter_than_half(lengths: Tensor, box: Tensor) -> None:
    """An error for bonds (bond,) not shorter than half of the smallest distance of opposite faces of the periodic cell."""
    width = box.min().item() if box.ndim == 1 else 1 / torch.linalg.inv(box).norm(dim=0).max().item()
    rule = f"be less than half the box, {width / 2:.6g}, where bonds do not name the copy that they end at"
    checks.first_bad("length of bonds", rule, lengths, lengths >= width / 2, "bond")


def check_doubles(bonds: Tensor, images: Tensor | None) -> None:
    """An error for two bonds that join the same two particles, and the same copies of them."""
    if not len(bonds):
        return
    low, high = bonds.amin(-1), bonds.amax(-1)
    columns = [low, high]
    if images is not None:
        turned = torch.where((bonds[:, 0] > bonds[:, 1])[:, None], -images, images)
        same = low == high  # a particle and its own copy: either sense is the same bond
        first = turned.gather(1, (turned != 0).to(torch.int8).argmax(-1, keepdim=True))[:, 0]
        turned = torch.where((same & (first < 0))[:, None], -turned, turned)
        columns += list(turned.unbind(-1))
    key = np.stack([column.cpu().numpy() for column in reversed(columns)])
    order = np.lexsort(key)
    doubled = (np.diff(key[:, order], axis=1) == 0).all(0)
    if doubled.any():
        at = int(np.flatnonzero(doubled)[0])
        a, b = sorted((int(order[at]), int(order[at + 1])))
        raise checks.fail("bonds", "differ from each other", f"{_pair(bonds, b)} at bonds {a + 1} and {b + 1}")


def _refuse(bonds: Tensor, bad: Tensor, rule: str, what: str = "") -> None:
    if bool(bad.any()):
        b = int(bad.nonzero()[0])
        raise checks.fail("bonds", rule, f"{what}{_pair(bonds, b)}{',' if what else ''} at bond {b + 1}")


def _pair(bonds: Tensor, b: int) -> str:
    return f"{int(bonds[b, 0])} and {int(bonds[b, 1])}"


def _as_tensor(field: str, value: Any, words: str) -> Tensor:
    """A tensor of integers or real numbers, infinite ones among them, from whatever holds them."""
    try:
        values = value if isinstance(value, Tensor) else torch.from_numpy(np.array(value))
    except (TypeError, ValueError, OverflowError, RuntimeError):
        values = torch.zeros(0, dtype=torch.bool)
    if values.is_complex() or values.dtype == torch.bool or values.layout != torch.strided or values.is_meta:
        raise checks.FieldTypeError(f"{field} must be {words}, got {checks.shown(value)}")
    return values
