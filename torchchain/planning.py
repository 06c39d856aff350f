"""The cheapest method that meets a scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from torchchain.scene import Scene


@dataclass(frozen=True)
class Plan:
    """The method chosen for a scene, its options, and why."""

    method: str
    options: dict[str, Any] = field(default_factory=dict)
    reasons: tuple[str, ...] = ()


def plan(scene: Scene) -> Plan:
    """The method for a scene: all normal modes."""
    return Plan("modes", reasons=("exact at every time",))
