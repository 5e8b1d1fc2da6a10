"""A small record for tests of what is made from records."""

import math

import numpy as np

from cldof.benchmark.pictures import data_uri
from cldof.benchmark.record import Record, Row, Times
from cldof.benchmark.unit import Unit

__all__ = ["NASTY", "UNIT", "accumulation", "layered", "small_record"]

NASTY = "a</script><script>alert(1)</script><img src=x onerror=alert(2)> 8x8"
TIMES = Times(1.0, 2.0, 0.5, 3)
UNIT = Unit(Times(98.0, 100.0, 2.0, 3, 200.0, 196.0, 4.0), Times(1.0, 1.5, 0.1, 3), threads=2, opencv="1.2")


def accumulation(case: str, views: int, ms: float, psnr: float, aperture: str = "gaussian") -> Row:
    """One rung of the accumulation ladder."""
    errors = {"method": {"psnr_db": psnr}, "disc": {"psnr_db": psnr + 1.0}}
    name = f"{views} views"
    return Row(f"{case}|accumulate|{name}", case, "accumulate", name, "OpenGL", aperture, ms, errors, views=views)


def layered(case: str, psnr: float, setting: str = "default", ms: float = 10.0, device: str = "a device") -> Row:
    """A row of a method."""
    errors = {"method": {"psnr_db": psnr, "ssim": 0.9}, "picture": {"psnr_db": psnr - 1.0}, "disc": {"psnr_db": 30.0}}
    key = f"{case}|layered|{setting}|{device}"
    times = {"capture": TIMES, "transfer": TIMES, "kernels": TIMES, "wall": TIMES, "unit": UNIT}
    return Row(key, case, "layered", setting, device, "gaussian", ms, errors, peels=4, build_ms=50.0, **times)


def small_record(case: str = "row 8x8") -> Record:
    """A case with a ladder of accumulation and two rows of the layered method."""
    rows = [
        accumulation(case, 8, 100.0, 30.0),
        accumulation(case, 32, 400.0, 40.0),
        layered(case, 35.0),
        layered(case, math.inf, "exact"),
    ]
    image = np.full((8, 8, 4), 0.5, np.float32)
    return Record(
        run={"cldof": "1", "commit": None, "date": "2000-01-01", "cpu_cores": 2, "system": "X", "seed": 0, "runs": 3},
        devices={"a device": {"compute_units": 2, "driver_version": "1", "copy_16_mb": {"median_ms": 1.5}}},
        cases={case: {"scene": case, "unlit": False, "width": 8, "height": 8}},
        references={
            f"{case}|gaussian|not jittered": {"views": 64, "noise_floor_db": 55.0, "seconds": 1.0},
            f"{case}|gaussian|jittered": {"views": 64, "noise_floor_db": math.inf, "seconds": None},
        },
        rows={row.key: row for row in rows},
        skipped={f"{case}|vtk|pass": "vtk: vtk is not installed (pip install vtk)"},
        images={f"{case}|pinhole": data_uri(image), f"{case}|reference, gaussian lens": data_uri(image)},
    )
