"""The renderer: frames in a row, in flight, from threads, with the caller's objects, and its errors."""

import gc
import threading

import numpy as np
import pytest

from cldof import DeviceError, InputError, LayeredFrame, Lens, Renderer
from cldof.host import opencl as cl
from cldof.host.device import Device, DeviceInfo
from tests.frames import noise_frame


def lens_for(frame: LayeredFrame, coc_px: float = 6.0, focus_m: float = 1.7) -> Lens:
    return Lens(coc_px / frame.camera.focal_px, focus_m)


def test_frames_in_a_row_are_the_same_as_alone(device_info: DeviceInfo) -> None:
    """Sizes, lenses, peels and voids in turn: nothing is left over from the frame before."""
    frames = [noise_frame(*size, layers, opaque=opaque) for size, layers, opaque in (
        ((70, 40), 3, True), ((31, 57), 2, False), ((70, 40), 4, True), ((5, 3), 1, True), ((70, 40), 3, False),
    )]  # fmt: skip
    jobs = [(frame, lens_for(frame, coc)) for coc in (2.0, 9.0) for frame in frames]
    alone = []
    for frame, lens in jobs:
        with Renderer(device=device_info.index) as one:
            alone.append(one.render(frame, lens).image)
    with Renderer(device=device_info.index) as renderer:
        for _ in range(2):
            for (frame, lens), expected in zip(jobs, alone, strict=True):
                np.testing.assert_array_equal(renderer.render(frame, lens).image, expected)


@pytest.mark.parametrize("out_of_order", [False, True])
@pytest.mark.parametrize("slots", [1, 2, 4])
def test_frames_in_flight(device_info: DeviceInfo, out_of_order: bool, slots: int) -> None:
    frames = [noise_frame(90, 70, seed=seed) for seed in range(5)]
    with Renderer(device=device_info.index, out_of_order=out_of_order, frames_in_flight=slots) as renderer:
        expected = [renderer.render(frame, lens_for(frame)).image for frame in frames]
        for _ in range(3):
            pending = [renderer.render_async(frame, lens_for(frame)) for frame in frames]
            for one, image in zip(pending, expected, strict=True):
                np.testing.assert_array_equal(one.result().image, image)
                assert one.done()


def test_a_steady_frame_allocates_nothing(device_info: DeviceInfo) -> None:
    frames = [noise_frame(90, 70, seed=seed) for seed in range(4)]
    out = np.empty((70, 90, 4), np.float32)
    with Renderer(device=device_info.index) as renderer:
        for frame in frames:
            renderer.render(frame, lens_for(frame), out=out)
        held = renderer.device.pool.allocated_bytes
        for turn in range(6):
            for frame in frames:
                # The lens moves, but not so far that other layers are needed.
                renderer.render(frame, lens_for(frame, 6.0 - 1e-3 * turn), out=out)
        assert renderer.device.pool.allocated_bytes == held


def test_sizes_that_do_not_come_back_are_given_back(device_info: DeviceInfo) -> None:
    """A renderer keeps no more memory for reuse than it uses, however many kinds of frame it has seen."""
    with Renderer("layered", device=device_info.index) as renderer:
        pool = renderer.device.pool
        for side in range(400, 40, -40):
            renderer.render(noise_frame(side, side), Lens(0.05, 2.0))
            assert pool.allocated_bytes <= 2 * pool.in_use_bytes


@pytest.mark.parametrize("method", ["layered", "multiview"])
def test_supersampled_images_are_means_or_middles(method: str, device_info: DeviceInfo) -> None:
    frame = noise_frame(60, 33, guard_px=6)
    sharp = Lens(0.0, 2.0)
    blocks = frame.pinhole_image().reshape(11, 3, 20, 3, 4)
    for antialias, expected in ((True, blocks.mean(axis=(1, 3))), (False, blocks[:, 1, :, 1])):
        with Renderer(method, device=device_info.index, supersample=3, antialias=antialias) as renderer:
            assert renderer.render(frame, sharp).image == pytest.approx(expected, abs=2e-6)
    with pytest.raises(InputError, match="use an odd number"):
        Renderer(method, device=device_info.index, supersample=2, antialias=False)


def test_the_middles_are_those_of_the_whole(device_info: DeviceInfo) -> None:
    frame = noise_frame(60, 33, guard_px=6)
    with Renderer("layered", device=device_info.index) as renderer:
        whole = renderer.render(frame, lens_for(frame)).image
    with Renderer("layered", device=device_info.index, supersample=3, antialias=False) as renderer:
        assert np.array_equal(renderer.render(frame, lens_for(frame)).image, whole[1::3, 1::3])


def test_out_is_filled_and_returned(device_info: DeviceInfo) -> None:
    frame = noise_frame(20, 10)
    out = np.full((10, 20, 4), np.nan, np.float32)
    with Renderer(device=device_info.index) as renderer:
        result = renderer.render(frame, lens_for(frame), out=out)
        assert result.image is out
        assert np.isfinite(out).all()
        read_only = np.empty((10, 20, 4), np.float32)
        read_only.setflags(write=False)
        for bad in (np.empty((10, 20, 3), np.float32), np.empty((10, 20, 4)), out[::-1], read_only, [1, 2]):
            with pytest.raises(InputError, match="out "):
                renderer.render(frame, lens_for(frame), out=bad)  # type: ignore[arg-type]


def test_timings_name_the_passes(device_info: DeviceInfo) -> None:
    frame = noise_frame(60, 40)
    with Renderer(device=device_info.index, profile=True) as renderer:
        result = renderer.render(frame, lens_for(frame))
    labels = [timing.label for timing in result.timings]
    assert labels[0] == "layered_matting"
    assert labels[-1] == "layered_resolve"
    assert all(timing.ms >= 0.0 for timing in result.timings)
    assert result.wall_ms >= sum(timing.ms for timing in result.timings) * 0.5
    assert result.plan.summary["layers"] == len([label for label in labels if label == "layered_step"]) + 1


def test_the_callers_own_queue(device: Device) -> None:
    frame = noise_frame(60, 40)
    context = cl.Context([device.queue.device])
    queue = cl.CommandQueue(context)
    with Renderer(device=device.info.index) as renderer:
        expected = renderer.render(frame, lens_for(frame)).image
    for given in ({"queue": queue}, {"context": context}, {"context": context, "queue": queue}):
        with Renderer(**given) as renderer:
            np.testing.assert_array_equal(renderer.render(frame, lens_for(frame)).image, expected)
    queue.finish()  # still the caller's, still alive


def test_threads_take_turns(device_info: DeviceInfo) -> None:
    frames = [noise_frame(64, 48, seed=seed) for seed in range(4)]
    with Renderer(device=device_info.index) as renderer:
        expected = [renderer.render(frame, lens_for(frame)).image for frame in frames]
        found: dict[int, list[np.ndarray]] = {}

        def work(index: int) -> None:
            found[index] = [renderer.render(frames[index], lens_for(frames[index])).image for _ in range(8)]

        threads = [threading.Thread(target=work, args=(index,)) for index in range(len(frames))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    for index, images in found.items():
        assert len(images) == 8
        for image in images:
            np.testing.assert_array_equal(image, expected[index])


def test_two_renderers_at_once(device_info: DeviceInfo) -> None:
    frame = noise_frame(64, 48)
    with Renderer(device=device_info.index) as a, Renderer(device=device_info.index) as b:
        first = a.render_async(frame, lens_for(frame))
        second = b.render_async(frame, lens_for(frame))
        np.testing.assert_array_equal(first.result().image, second.result().image)


def test_a_frame_may_be_dropped_while_it_is_rendered(device_info: DeviceInfo) -> None:
    with Renderer(device=device_info.index) as renderer:
        frame = noise_frame(120, 90)
        expected = renderer.render(frame, lens_for(frame)).image
        pending = renderer.render_async(noise_frame(120, 90), lens_for(frame))
        for seed in range(3):  # push it out of the renderer's memory too
            other = noise_frame(120, 90, seed=seed)
            renderer.render_async(other, lens_for(other))
        gc.collect()
        np.testing.assert_array_equal(pending.result().image, expected)


def test_closed_renderer(device_info: DeviceInfo) -> None:
    frame = noise_frame(20, 10)
    renderer = Renderer(device=device_info.index)
    pending = renderer.render_async(frame, lens_for(frame))
    renderer.close()
    renderer.close()
    assert np.isfinite(pending.result().image).all()
    with pytest.raises(DeviceError, match="closed"):
        renderer.render(frame, lens_for(frame))


def test_an_error_leaves_the_renderer_usable(device_info: DeviceInfo) -> None:
    frame = noise_frame(20, 10)
    with Renderer(device=device_info.index) as renderer:
        with pytest.raises(InputError):
            renderer.render(frame, "f/2")  # type: ignore[arg-type]
        with pytest.raises(InputError):
            renderer.render(np.zeros((10, 20)), lens_for(frame))  # type: ignore[arg-type]
        assert np.isfinite(renderer.render(frame, lens_for(frame)).image).all()


def test_bad_arguments(device_info: DeviceInfo) -> None:
    with pytest.raises(InputError, match="'depth-of-field' is unknown; choose one of"):
        Renderer("depth-of-field")
    with pytest.raises(InputError, match="unexpected keyword argument 'sample'"):
        Renderer(sample=3)
    with pytest.raises(InputError, match="frames_in_flight"):
        Renderer(device=device_info.index, frames_in_flight=0)
    with pytest.raises(DeviceError, match="no such gadget"):
        Renderer(device="no such gadget")
    with pytest.raises(InputError, match="not both"):
        Renderer(device=0, queue=object())


@pytest.mark.parametrize("factor", [2, 3])
@pytest.mark.parametrize("opaque", [True, False])
def test_supersampling_is_a_box_filter_after_the_blur(device_info: DeviceInfo, factor: int, opaque: bool) -> None:
    frame = noise_frame(37 * factor, 20 * factor, opaque=opaque, guard_px=4)
    lens = lens_for(frame)
    with Renderer(device=device_info.index) as renderer:
        full = renderer.render(frame, lens).image
    with Renderer(device=device_info.index, supersample=factor) as renderer:
        image = renderer.render(frame, lens).image
    expected = full.reshape(20, factor, 37, factor, 4).mean(axis=(1, 3), dtype=np.float64)
    np.testing.assert_allclose(image, expected, atol=1e-6)


def test_supersampling_needs_a_size_that_divides(device_info: DeviceInfo) -> None:
    frame = noise_frame(21, 20)
    with Renderer(device=device_info.index, supersample=2) as renderer, pytest.raises(InputError, match="21x20"):
        renderer.render(frame, lens_for(frame))
    with pytest.raises(InputError, match="supersample is 0"):
        Renderer(device=device_info.index, supersample=0)
