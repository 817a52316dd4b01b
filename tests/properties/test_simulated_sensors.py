"""Patterns of shots and shutters that hold for any numbers."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneloom.cameras.camera import Camera
from sceneloom.simulate import CameraSpec, LidarSpec, Raster, Rosette, SolidStateSpec
from sceneloom.simulate.camera import Exposure, ExposureSpec
from sceneloom.simulate.drive import Rig


@given(
    rows=st.integers(1, 12),
    columns=st.integers(1, 9),
    channels=st.integers(1, 4),
    passes=st.integers(1, 12),
    period_ns=st.integers(1_000, 10**9),
)
@settings(max_examples=60)
def test_a_raster_shoots_at_each_of_its_cells_once_and_in_the_order_of_time(rows, columns, channels, passes, period_ns):
    raster = Raster((-40.0, 40.0), (-5.0, 5.0), rows, columns, channels, passes)
    shots = raster.plan_shots(period_ns)(0)
    directions = shots.rays.spread()
    azimuths = np.degrees(np.arctan2(directions[:, 1], directions[:, 0]))
    cells = np.rint((40.0 - azimuths) / (80.0 / (columns * channels)) - 0.5).astype(int)
    locations = set(zip(shots.rings.tolist(), cells.tolist(), strict=True))
    assert locations == {(ring, cell) for ring in range(rows) for cell in range(columns * channels)}
    assert len(shots.moments) == rows * columns * channels
    assert (np.diff(shots.moments) >= 0).all()
    assert 0 == shots.offsets_ns[0] <= shots.offsets_ns[-1] < period_ns


@given(
    fov_deg=st.floats(1.0, 160.0),
    rotations=st.tuples(st.floats(-9000, 9000), st.floats(-9000, 9000)),
    share=st.floats(0.0, 1.0),
    elapsed_ns=st.integers(0, 10**12),
)
@settings(max_examples=60)
def test_a_rosette_stays_between_its_least_and_its_greatest_bend(fov_deg, rotations, share, elapsed_ns):
    shots = Rosette(fov_deg, 5000.0, rotations, share).plan_shots(20_000_000)(elapsed_ns)
    off_axis = np.degrees(np.arccos(shots.rays.spread()[:, 0].clip(-1.0, 1.0)))
    # The arc cosine loses half of the digits near the axis: 1e-8 rad.
    assert off_axis.max() <= fov_deg / 2 + 2e-6
    assert off_axis.min() >= abs(2 * share - 1) * fov_deg / 2 - 2e-6
    assert len(shots.moments) == 100
    assert shots.rings is None


@given(
    height=st.integers(2, 50), width=st.integers(2, 50), readout_ns=st.integers(1, 10**8), left_to_right=st.booleans()
)
def test_the_lines_of_a_shutter_lie_evenly_around_the_images_time(height, width, readout_ns, left_to_right):
    camera = Camera("pinhole", width, height, 30.0, 30.0, 10.0, 10.0)
    offsets = CameraSpec(camera, readout_ns=readout_ns, left_to_right=left_to_right).line_offsets_ns()
    count = width if left_to_right else height
    assert len(offsets) == count
    # Rounding to whole nanoseconds is half a nanosecond at either end.
    assert np.abs(offsets + offsets[::-1]).max() <= 1
    assert abs(offsets[-1] - offsets[0] - readout_ns * (count - 1) / count) <= 1


@given(
    frames=st.integers(1, 30),
    first_ns=st.integers(10**6, 10**9),
    other_ns=st.integers(10**6, 10**9),
    share=st.floats(0.0, 0.999),
)
def test_each_device_begins_its_frames_while_the_drive_lasts(frames, first_ns, other_ns, share):
    other = SolidStateSpec(Raster(rows=1, columns=1), period_ns=other_ns, offset_ns=int(share * other_ns))
    lidars = (LidarSpec(beams=1, steps=1, period_ns=first_ns), other)
    rig = Rig.of(lidars, (), (), frames=frames, start_ns=-5)
    first, second = (rig.frame_starts_ns(spec) for spec in lidars)
    stop = -5 + frames * first_ns
    assert first.tolist() == list(range(-5, stop, first_ns))
    assert second.tolist() == list(range(-5 + other.offset_ns, stop, other_ns))
    assert rig.span_ns[1] >= max(stop, *(second + other_ns).tolist(), stop)
    assert rig.span_ns[0] < -5


@given(
    seed=st.integers(0, 2**32),
    at_ns=st.integers(0, 10**12),
    drift=st.floats(0.0, 4.0),
    step=st.floats(-4.0, 4.0),
    begin=st.floats(0.0, 100.0),
)
def test_the_gain_stays_within_drift_and_step(seed, at_ns, drift, step, begin):
    spec = ExposureSpec(drift_stops=drift, steps=((begin, step),))
    stops = np.log2(Exposure.of(spec, start_ns=0, seed=seed, camera=1).gain(at_ns))
    assert -drift + min(0.0, step) - 1e-9 <= stops <= drift + max(0.0, step) + 1e-9
