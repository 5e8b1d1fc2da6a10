"""Devices told to be less than they are: ``CLDOF_TEST_LIMITS=64,32768[,gpu]``.

Every device then has work-groups of at most 64 and 32768 bytes of local memory, and with ``gpu`` is no CPU: kernels
take the forms that GPUs get. Tests see it by :mod:`tests.conftest`; ``python -m tests.limits MODULE ARGUMENTS`` runs
any module so.
"""

from __future__ import annotations

import os
import runpy
import sys
from dataclasses import replace
from functools import cached_property
from typing import Any

from cldof.host.device import Device, Traits
from cldof.host.lanes import GPU_LANES

__all__ = ["VARIABLE", "limit_devices"]

VARIABLE = "CLDOF_TEST_LIMITS"


def limit_devices() -> None:
    """Do what the variable says, for every device that this process opens; nothing without it."""
    if not (limits := os.environ.get(VARIABLE)):
        return
    group, local_bytes, *kind = limits.split(",")
    real: Any = Device.traits.func  # type: ignore[attr-defined]

    def small(device: Device) -> Traits:
        group_size = min(int(group), (traits := real(device)).max_work_group_size)
        return replace(
            traits,
            max_work_group_size=group_size,
            preferred_group_limit=min(group_size, traits.preferred_group_limit),
            local_mem_bytes=min(int(local_bytes), traits.local_mem_bytes),
            is_cpu=traits.is_cpu and not kind,
        )

    _replace("traits", small)
    if kind:
        chosen: Any = Device.lanes.func  # type: ignore[attr-defined]
        _replace("lanes", lambda device: chosen(device) if device._lanes is not None else GPU_LANES)


def _replace(name: str, function: Any) -> None:
    replaced = cached_property(function)
    replaced.__set_name__(Device, name)
    setattr(Device, name, replaced)


if __name__ == "__main__":
    limit_devices()
    sys.argv = sys.argv[1:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
