"""Which tests go to which process of ``pytest -n 2``: all that build the same programs to one.

Every process has its own folder of built programs, so what two of them build is built twice. Tests of a method share
its programs, and those of one file their fixtures.
"""

from __future__ import annotations

import re

from xdist.scheduler import LoadScopeScheduling

from cldof.methods import METHODS

__all__ = ["ByMethod", "group_of"]

# Where tests are of one method each, by the name of the file or of a parameter.
_BY_METHOD = re.compile(rf"tests/(?:hard_cases|kernels|methods|planner)/.*?({'|'.join(METHODS)})")


class ByMethod(LoadScopeScheduling):  # type: ignore[misc]
    """Hands out the tests of a method, or of a file, as a whole; the largest first."""

    def _split_scope(self, nodeid: str) -> str:
        return group_of(nodeid)


def group_of(nodeid: str) -> str:
    """Method or file."""
    found = _BY_METHOD.match(nodeid)
    return found[1] if found else nodeid.split("::", 1)[0]
