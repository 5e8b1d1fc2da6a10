"""Which processor this is: drivers for CPUs compile for it, and crash over some and not over others."""

from __future__ import annotations

import hashlib
import platform
from functools import lru_cache

__all__ = ["processor_digest", "processor_name"]


def processor_name() -> str:
    """For people: name and, where the system tells, family and model."""
    facts = _facts()
    name = facts.get("model name") or platform.processor() or platform.machine() or "unknown"
    numbers = [f"{key} {facts[key]}" for key in ("cpu family", "model") if key in facts]
    if not numbers and "CPU part" in facts:  # Arm
        numbers = [f"{key} {facts[key]}" for key in ("CPU implementer", "CPU part") if key in facts]
    return f"{' '.join(name.split())} ({', '.join([platform.machine(), *numbers])})"


def processor_digest() -> str:
    """Changes with all that a compiler may go by: name, numbers and features."""
    facts = _facts()
    features = facts.get("flags") or facts.get("Features") or ""
    return hashlib.sha256(f"{processor_name()}\0{' '.join(sorted(features.split()))}".encode()).hexdigest()


@lru_cache(maxsize=1)
def _facts() -> dict[str, str]:
    """What Linux says of the first processor; nothing elsewhere."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            first = file.read().split("\n\n", 1)[0]
    except OSError:
        return {}
    pairs = (line.partition(":") for line in first.splitlines())
    return {key.strip(): value.strip() for key, _, value in pairs}
