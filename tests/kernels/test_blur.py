"""Both Gaussian engines against float64."""

import numpy as np
import pytest

from cldof.host.device import Device
from cldof.host.passes import Local
from cldof.methods import gaussian
from cldof.methods.base import row_pitch
from tests.oracles import gaussian as oracle
from tests.running import padded, run_pass
from tests.tolerances import assert_close

SIZES = [(1, 1), (1, 37), (41, 1), (37, 21), (97, 131), (64, 600)]
SIGMAS = [0.3, 0.7, 1.0, 2.3, 4.0, 9.0]
ALL_SIGMAS = [0.3, 0.5, 1.0, 1.7, 3.0, 8.0, 20.0, 50.0, 120.0, 200.0]


def image_of(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width, 4), np.float32)


def fir(device: Device, image: np.ndarray, taps: np.ndarray, segment: int = 64) -> np.ndarray:
    height, width = image.shape[:2]
    pitch = row_pitch(width)
    radius = len(taps) // 2
    halo = (radius + 4) & ~3
    args = [
        padded(image, pitch),
        gaussian.half_taps(taps),
        *(np.int32(n) for n in (width, height, pitch, radius, segment)),
        Local(8 * (segment + 2 * halo) * 16),
    ]
    groups = (-(-pitch // segment), -(-height // 8))
    out = run_pass(device, "blur", "blur_fir", args, (height, pitch, 4), groups, (1, 1))
    return out[:, :width]


def iir(device: Device, image: np.ndarray, sigma: float) -> np.ndarray:
    height, width = image.shape[:2]
    pitch = row_pitch(width)
    sections = gaussian.iir_sections(sigma)
    extent = [np.int32(n) for n in (width, height, pitch)]
    shape = (height, pitch, 4)
    rows = run_pass(
        device,
        "blur",
        "blur_iir_rows",
        [padded(image, pitch), sections, *extent],
        shape,
        (-(-height // (device.lanes // 4)),),
    )
    rows = padded(rows[:, :width], pitch)
    out = run_pass(
        device, "blur", "blur_iir_columns", [rows, sections, *extent], shape, (-(-width // (device.lanes // 4)),)
    )
    return out[:, :width]


def iir_taps(sigma: float) -> np.ndarray:
    """Impulse response of the sections that the kernel gets, in float64."""
    pole_re, pole_im, gain_re, gain_im, _, _ = gaussian.iir_sections(sigma).astype(np.float64).T
    n = np.arange(int(12 * sigma) + 2)[:, np.newaxis]
    half = ((gain_re + 1j * gain_im) * (pole_re + 1j * pole_im) ** n).real.sum(axis=1)
    return np.concatenate([half[:0:-1], half])


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("sigma", SIGMAS)
def test_fir_meets_the_oracle(device: Device, size: tuple[int, int], sigma: float) -> None:
    image = image_of(*size)
    taps = gaussian.fir_taps(sigma)
    assert_close(fir(device, image, taps), oracle.blur(image, taps), "blur_fir")


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("sigma", SIGMAS)
def test_iir_meets_the_oracle(device: Device, size: tuple[int, int], sigma: float) -> None:
    image = image_of(*size)
    assert_close(iir(device, image, sigma), oracle.blur(image, iir_taps(sigma)), "blur_iir")


def corner(height: int, width: int) -> np.ndarray:
    """A quarter-plane of ones: the worst image in [0, 1] for a kernel that is too light in its tails."""
    image = np.zeros((height, width, 4), np.float32)
    image[height // 2 :, width // 2 :] = 1.0
    return image


@pytest.mark.parametrize("sigma", ALL_SIGMAS)
@pytest.mark.parametrize("size", [(1, 1), (1, 211), (211, 1), (127, 139)])
def test_engines_are_gaussian(device: Device, size: tuple[int, int], sigma: float) -> None:
    for image in (image_of(*size, seed=1), corner(*size)):
        expected = oracle.blur(image, oracle.exact_taps(sigma))
        assert_close(iir(device, image, sigma), expected, "gaussian")
        if sigma <= 20.0:
            assert_close(fir(device, image, gaussian.fir_taps(sigma, cutoff=3.3)), expected, "gaussian")


def test_engines_are_gaussian_in_full_hd(device: Device) -> None:
    if not device.traits.is_cpu or "llvmpipe" in device.traits.name:
        pytest.skip("the size matters for CPU drivers' row splitting; llvmpipe takes minutes")
    image = image_of(1080, 1920)
    for sigma in (3.0, 200.0):
        expected = oracle.blur(image, oracle.exact_taps(sigma))
        assert_close(iir(device, image, sigma), expected, "gaussian")
    assert_close(
        fir(device, image, gaussian.fir_taps(3.0, cutoff=3.3), segment=512),
        oracle.blur(image, oracle.exact_taps(3.0)),
        "gaussian",
    )


@pytest.mark.parametrize("sigma", [0.3, 1.0, 4.0, 12.0])
def test_an_impulse_keeps_its_energy(device: Device, sigma: float) -> None:
    image = np.zeros((151, 163, 4), np.float32)
    image[75, 81] = 1000.0
    for out in (fir(device, image, gaussian.fir_taps(sigma)), iir(device, image, sigma)):
        np.testing.assert_allclose(out.sum(axis=(0, 1), dtype=np.float64), 1000.0, rtol=1e-3)


@pytest.mark.parametrize("sigma", [0.3, 3.0, 50.0, 200.0])
def test_a_constant_stays_constant(device: Device, sigma: float) -> None:
    image = np.full((53, 67, 4), 0.7, np.float32)
    np.testing.assert_allclose(iir(device, image, sigma), image, rtol=3e-6)
    if sigma <= 3.0:
        np.testing.assert_allclose(fir(device, image, gaussian.fir_taps(sigma)), image, rtol=1e-6)


@pytest.mark.parametrize("sigma", [2.0, 30.0])
def test_mirror_symmetry(device: Device, sigma: float) -> None:
    image = image_of(48, 80, seed=2)
    straight, mirrored = iir(device, image, sigma), iir(device, np.ascontiguousarray(image[::-1, ::-1]), sigma)
    np.testing.assert_allclose(mirrored[::-1, ::-1], straight, atol=3e-6)


def test_float32_recursion_stays_close_to_float64() -> None:
    """The reason for one-pole sections: at sigma 200 the poles are within 1/100 of 1 and float32 still holds."""
    sections = gaussian.iir_sections(200.0)
    signal = np.random.default_rng(3).random(4000)
    results = []
    for dtype, complex_type in ((np.float32, np.complex64), (np.float64, np.complex128)):
        values = sections.astype(dtype)
        poles, gains = (values[:, i] + 1j * values[:, i + 1] for i in (0, 2))
        state = np.zeros(len(sections), complex_type)
        out = np.empty(len(signal), dtype)
        for i, x in enumerate(signal.astype(dtype)):
            state = (poles.astype(complex_type) * state + x).astype(complex_type)
            out[i] = (gains * state).real.sum()
        results.append(out)
    assert np.abs(results[0] - results[1]).max() < 5e-6
