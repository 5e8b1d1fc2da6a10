"""Python runs this at its start when the folder is on PYTHONPATH; see tests/tools/feigned.py."""

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

# By its path: the process may run in any folder, and with another cldof than this tree's.
_spec = spec_from_file_location("cldof_test_feigned", Path(__file__).parents[1] / "feigned.py")
_feigned = module_from_spec(_spec)
sys.modules[_spec.name] = _feigned
_spec.loader.exec_module(_feigned)
_feigned.feign_when_imported()
_feigned.run_other_sitecustomize(__file__)
