"""Each model's packets against positions and times that are computed return by return from the public descriptions."""

import math
import struct

import numpy as np
import pytest
from tests.unit.formats.packets import build

from sceneloom.errors import DataError
from sceneloom.formats.packets import hesai, ouster, robosense, velodyne

RNG = np.random.default_rng(7)
VLP16 = [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]
HDL32 = [-30.67, -9.33, -29.33, -8.0, -28.0, -6.67, -26.67, -5.33, -25.33, -4.0, -24.0, -2.67, -22.67, -1.33, -21.33,
         0.0, -20.0, 1.33, -18.67, 2.67, -17.33, 4.0, -16.0, 5.33, -14.67, 6.67, -13.33, 8.0, -12.0, 9.33, -10.67,
         10.67]  # fmt: skip


def values(*shape, most=30000):
    distances = RNG.integers(1, most, shape)
    distances[RNG.random(shape) < 0.2] = 0
    return distances, RNG.integers(0, 256, shape)


def decoded(decoder, *packets, length=None):
    array = np.frombuffer(b"".join(packets), np.uint8).reshape(len(packets), -1)
    survey = decoder.survey(array)
    assert survey.usable.all()
    points = decoder.points(array, np.full(len(array), 1000), np.ones(survey.phases.shape, bool))
    return survey, points


def agree(points, expected, *, tolerance=5e-5):
    """Compare with rows of x, y, z, time [ns], ring, intensity, return number."""
    expected = sorted(expected, key=lambda row: (row[3], row[4], row[6]))
    rows, times_ns = np.array(expected, float), np.array([row[3] for row in expected])
    numbers = points.extras.get("return_number", np.ones(len(points)))
    order = np.lexsort((numbers, points.rings, points.timestamps_ns))
    assert len(points) == len(rows)
    np.testing.assert_allclose(points.positions[order], rows[:, :3], atol=tolerance, rtol=1e-6)
    assert np.abs(points.timestamps_ns[order] - times_ns).max() <= 1
    assert np.array_equal(points.rings[order], rows[:, 4])
    assert np.array_equal(points.intensities[order], rows[:, 5])
    assert np.array_equal(numbers[order], rows[:, 6])


@pytest.mark.parametrize("dual", [False, True])
@pytest.mark.parametrize("key", ["vlp-16", "hdl-32e"])
def test_velodyne_returns_lie_and_were_measured_where_and_when_the_manuals_say(key, dual):
    distances, intensities = values(12, 32)
    if dual:  # of two equal returns of a firing one counts
        distances[1::2], intensities[1::2] = np.where(RNG.random((6, 32)) < 0.5, (distances[::2], intensities[::2]),
                                                      (distances[1::2], intensities[1::2]))  # fmt: skip
    step, firing = (40, 110.592) if key == "vlp-16" else (16, 46.08)
    azimuths = [(35900 + step * (k // 2 if dual else k)) % 36000 for k in range(12)]
    packet = build.velodyne(azimuths, distances, intensities, time_us=3_599_999_000, mode=0x39 if dual else 0x37,
                            product=0x22 if key == "vlp-16" else 0x21)  # fmt: skip
    elevations = VLP16 if key == "vlp-16" else HDL32
    rings = np.argsort(np.argsort(elevations))
    expected = []
    for block in range(12):
        for channel in range(32):
            distance, number = distances[block][channel], 1 + (dual and block % 2)
            pair = (distances[block - 1][channel], intensities[block - 1][channel])
            if not distance or (number == 2 and pair == (distance, intensities[block][channel])):
                continue
            if key == "vlp-16":
                after, laser, height = 55.296 * (channel // 16) + 2.304 * (channel % 16), channel % 16, 0.04191
            else:
                after, laser, height = 1.152 * channel, channel, 0.02895
            azimuth = math.radians((azimuths[block] + step * after / firing) / 100)
            elevation, metres = math.radians(elevations[laser]), distance * 0.002
            level = metres * math.cos(elevation)
            z = metres * math.sin(elevation) - height * math.tan(elevation)
            time = 3_599_999_000_000 + 1000 + 1000 * (firing * (block // 2 if dual else block) + after)
            row = (level * math.cos(azimuth), -level * math.sin(azimuth), z, round(time), rings[laser])
            expected.append((*row, intensities[block][channel], number))
    survey, points = decoded(velodyne.VelodyneDecoder(key), packet)
    agree(points, expected)
    assert survey.phases[0, 0] == pytest.approx(0.99722, abs=1e-5)


@pytest.mark.parametrize(("dual", "own_azimuths"), [(False, False), (False, True), (True, False)])
def test_vls_128_fires_four_banks_of_32_lasers_eight_at_a_time(dual, own_azimuths):
    # 3 firings of 4 banks, or one with two returns of each bank and four blocks that hold nothing; 10 turns a second
    banks = [0, 0, 1, 1, 2, 2, 3, 3] if dual else [0, 1, 2, 3] * 3
    flags = tuple((0xEEFF, 0xDDFF, 0xCCFF, 0xBBFF)[bank] for bank in banks) + (0xFFFF,) * (12 - len(banks))
    speed = 0.36  # 0.01 degree / µs, as 10 turns a second have it
    packets, expected = [], []
    decoder = velodyne.decoder_of("vls-128", None)
    for number in range(2):
        time_us = 1_000_000 + number * round(57.8 * (1 if dual else 3))
        distances, intensities = values(12, 32)
        azimuths = [0] * 12
        for block, bank in enumerate(banks):
            firing = 0 if dual else block // 4
            started_us = 57.8 * firing + (2.89 * (4 * bank + bank // 2 * 2) if own_azimuths else 0)
            azimuths[block] = round(35_000 + speed * (time_us - 1_000_000 + started_us))
            for channel in range(32):
                metres, laser = distances[block][channel] * 0.004, 32 * bank + channel
                second = dual and block % 2
                pair = [(one[block - second][channel], one[block][channel]) for one in (distances, intensities)]
                if not metres or (second and all(a == b for a, b in pair)):
                    continue
                after_us = 57.8 * firing + 2.89 * (laser // 8 + laser // 64 * 2)
                spread = (635.4, 454.8, 273.2, 91.1, -91.1, -273.2, -454.8, -635.4)[laser % 8]
                azimuth = math.radians((azimuths[block] + speed * (after_us - started_us) + spread) / 100)
                elevation = decoder._lasers[laser, 1]
                level = metres * math.cos(elevation)
                row = (
                    level * math.cos(azimuth),
                    -level * math.sin(azimuth),
                    metres * math.sin(elevation) - 0.05863 * math.tan(elevation),
                )
                time_ns = 1000 * time_us + 1000 + round((after_us - 7) * 1000)
                expected.append((*row, time_ns, laser, intensities[block][channel], 1 + second))
        mode = 0x39 if dual else 0x37
        packets.append(
            build.velodyne(azimuths, distances, intensities, time_us=time_us, mode=mode, product=0xA1, flags=flags)
        )
    assert velodyne.recognise(np.frombuffer(packets[0], np.uint8)[None]) == "vls-128"
    survey, points = decoded(decoder, *packets)
    order = np.argsort(np.argsort(decoder._lasers[:, 1], kind="stable"), kind="stable")
    assert sorted(np.rad2deg(decoder._lasers[:, 1]).round(3))[:2] == [-25.0, -19.582]
    agree(points, [(*row[:4], order[row[4]], *row[5:]) for row in expected], tolerance=0.03)
    assert survey.phases.max() < 1


def test_velodyne_models_are_told_by_the_packet_and_hdl_64e_need_their_calibration(tmp_path):
    distances, intensities = values(12, 32)
    for key, product in (("vlp-16", 0x22), ("puck-hi-res", 0x24), ("hdl-32e", 0x21), ("vlp-32c", 0x28)):
        packet = build.velodyne(range(12), distances, intensities, time_us=1, product=product)
        assert velodyne.recognise(np.frombuffer(packet, np.uint8)[None]) == key
    packet = build.velodyne(range(12), distances, intensities, time_us=1, flags=(0xEEFF, 0xDDFF) * 6, product=7)
    assert velodyne.recognise(np.frombuffer(packet, np.uint8)[None]) == "hdl-64e-s3"
    with pytest.raises(DataError, match="calibration of this HDL-64E"):
        velodyne.decoder_of("hdl-64e-s3", None)
    entries = "\n".join(
        f"  - laser_id: {k}\n    rot_correction: 0.1\n    vert_correction: {-0.01 * k}" for k in range(64)
    )
    (tmp_path / "a.yaml").write_text(f"distance_resolution: 0.002\nlasers:\n{entries}\nnum_lasers: 64\n")
    decoder = velodyne.decoder_of("hdl-64e-s3", tmp_path / "a.yaml")
    _, points = decoded(decoder, packet)
    assert set(points.rings) == set(range(64))  # both halves
    with pytest.raises(DataError, match="64 lasers; expected 16 of VLP-16"):
        velodyne.decoder_of("vlp-16", tmp_path / "a.yaml")


@pytest.mark.parametrize("mode", [0x37, 0x39])
@pytest.mark.parametrize("key", ["pandar40p", "pandar64", "xt16", "xt32", "xt32m", "qt64"])
def test_hesai_returns_lie_and_were_measured_where_and_when_the_manuals_say(key, mode, tmp_path):
    model = hesai.MODELS[key]
    blocks, channels = model.blocks, model.channels
    distances, intensities = values(blocks, channels)
    returns = 2 if mode == 0x39 else 1
    azimuths = [1000 + 20 * (k // returns) for k in range(blocks)]
    make = {"pandar40p": build.hesai_40p, "pandar64": build.hesai_64}.get(key, build.hesai)
    unit = 5 if key in ("xt32m", "pandar64") else 4
    how = {} if key == "pandar40p" else {"unit_mm": unit}
    packet = make(azimuths, distances, intensities, time_us=250_000, mode=mode, **how)
    elevations, offsets = RNG.uniform(-25, 20, channels).round(3), RNG.uniform(-5, 5, channels).round(3)
    lines = [f"{k + 1},{elevations[k]},{offsets[k]}" for k in range(channels)]
    (tmp_path / "a.csv").write_text("\n".join(["Laser id,Elevation,Azimuth", *lines]))
    expected = []
    for block in range(blocks):
        for channel in range(channels):
            if not distances[block][channel]:
                continue
            back = (blocks - 1 - block) // returns
            after = {
                "pandar40p": -28.58 - 55.56 * back,
                "pandar64": -42.58 - 55.56 * back,
                "xt16": 5.632 - 50 * back + 0.368 + 3.024 * channel,
                "xt32": 5.632 - 50 * back + 0.368 + 1.512 * channel,
                "xt32m": 5.632 - 50 * back + 0.368 + 2.888 * (channel % 16),
                "qt64": 25.71 + 500 / 3 * (block // returns),
            }[key] + (0 if key.startswith("xt") else model.channel_us[channel])
            azimuth = math.radians(azimuths[block] / 100 + offsets[channel])
            elevation, metres = math.radians(elevations[channel]), distances[block][channel] * unit / 1000
            level = metres * math.cos(elevation)
            row = (level * math.sin(azimuth), level * math.cos(azimuth), metres * math.sin(elevation))
            time = build.START_NS + 250_000_000 + 1000 + round(after * 1000)
            expected.append((*row, time, channel, intensities[block][channel], 1 + block % returns))
    assert hesai.recognise(np.frombuffer(packet, np.uint8)[None]) == key
    _, points = decoded(hesai.decoder_of(key, tmp_path / "a.csv"), packet)
    agree(points, expected)
    assert len(decoded(hesai.decoder_of(key, None), packet)[1]) == len(points)  # by the manual's angles


@pytest.mark.parametrize(("mode", "fine"), [(0x37, False), (0x37, True), (0x39, False)])
def test_ot128_fires_its_channels_in_another_order_in_high_resolution(mode, fine, tmp_path):
    distances, intensities = values(2, 128)
    elevations, offsets = RNG.uniform(-25, 15, 128).round(3), RNG.uniform(-5, 5, 128).round(3)
    lines = [f"{k + 1},{elevations[k]},{offsets[k]}" for k in range(128)]
    (tmp_path / "a.csv").write_text("\n".join(["Laser id,Elevation,Azimuth", *lines]))
    dual = mode == 0x39
    packet = build.hesai_ot128(
        [35_990, 35_990 if dual else 10], distances, intensities, time_us=5, mode=mode, fine=fine
    )
    model, expected = hesai.MODELS["ot128"], []
    assert (model.channel_us[0], model.channel_us[127], model.fine_us[0], model.fine_us[39]) == (
        49.758,
        30.156,
        21.98,
        0,
    )
    for block in range(2):
        for channel in range(128):
            azimuth = math.radians(([35_990, 35_990 if dual else 10][block]) / 100 + offsets[channel])
            elevation, metres = math.radians(elevations[channel]), distances[block][channel] * 0.004
            level = metres * math.cos(elevation)
            after = 43.346 - (0 if dual else 55.556 * (1 - block))
            after += (model.fine_us if fine else model.channel_us)[channel]
            time = 1_700_000_000_000_006_000 + round(after * 1000)
            row = (level * math.sin(azimuth), level * math.cos(azimuth), metres * math.sin(elevation), time, channel)
            if metres:
                expected.append((*row, intensities[block][channel], 1 + (dual and block)))
    assert hesai.recognise(np.frombuffer(packet, np.uint8)[None]) == "ot128"
    agree(decoded(hesai.decoder_of("ot128", tmp_path / "a.csv"), packet)[1], expected)
    with pytest.raises(DataError, match="expected the angles of this OT128"):
        hesai.decoder_of("ot128", None)


def test_at128_angles_are_twice_those_of_its_mirror_and_adjusted_by_its_file(tmp_path):
    starts = [30 * 25600, 150 * 25600, 270 * 25600]
    azimuths, elevations = RNG.integers(-40_000, 40_000, 128), RNG.integers(-330_000, 330_000, 128)
    adjust = RNG.integers(-60, 60, (2, 128, 180))
    (tmp_path / "a.dat").write_bytes(build.at_correction(starts, azimuths, elevations, *adjust))
    distances, intensities = values(2, 128)
    encoder = [161 * 25600 + 700, 161 * 25600 + 2_000]
    packet = build.hesai(encoder, distances, intensities, time_us=5, date=(1_700_000_000,))
    expected = []
    for block in range(2):
        for channel in range(128):
            at, part = divmod(encoder[block], 2 * 25600)
            weight = part / (2 * 25600)
            more = [one[channel][at] * (1 - weight) + one[channel][at + 1] * weight for one in adjust]
            azimuth = (encoder[block] - starts[1]) * 2 - azimuths[channel] + more[0] * 256
            elevation = math.radians((elevations[channel] + more[1] * 256) / 25600)
            azimuth, metres = math.radians(azimuth / 25600), distances[block][channel] * 0.004
            level = metres * math.cos(elevation)
            time = 1_700_000_000_000_006_000 + round((-9.249 - 41.666 * (2 - block)) * 1000)
            time += round(hesai.MODELS["at128"].channel_us[channel] * 1000)
            row = (level * math.sin(azimuth), level * math.cos(azimuth), metres * math.sin(elevation), time, channel)
            if metres:
                expected.append((*row, intensities[block][channel], 1))
    assert hesai.recognise(np.frombuffer(packet, np.uint8)[None]) == "at128"
    survey, points = decoded(hesai.decoder_of("at128", tmp_path / "a.dat"), packet)
    agree(points, expected)
    assert survey.phases[0, 0] % 1 == pytest.approx(11 / 120, abs=1e-3)
    with pytest.raises(DataError, match="expected the angle correction file"):
        hesai.decoder_of("at128", None)
    (tmp_path / "a.dat").write_bytes((tmp_path / "a.dat").read_bytes()[:-9])
    with pytest.raises(DataError, match="bytes; expected 47144"):
        hesai.decoder_of("at128", tmp_path / "a.dat")


ROBOSENSE = {  # step and origin [m], µs of a block, when a channel is fired, type of the older form
    "helios-16p": (0.0025, 0.03498, 0.0, 55.56, lambda k: 1.73 * k, None),
    "helios": (0.0025, 0.03498, 0.0, 55.56, lambda k: 1.73 * k, None),
    "bpearl": (0.005, 0.01473, 0.09427, 55.52, lambda k: 2.56 * (k % 16) + 1.28 * (k // 16) + 5.2 * (k // 8 % 2), 3),
    "bpearl-v4": (0.0025, 0.01619, 0.09571, 55.56, lambda k: 1.66783 * k, 3),
    "rs-16": (0.005, 0.03825, 0.0, 111.0, lambda k: 2.8 * (k % 16) + 55.5 * (k // 16), 1),
    "rs-32": (0.005, 0.03997, 0.0, 55.52, lambda k: 2.88 * (k % 16) + 1.44 * (k // 16 + (k % 16 == 15)), 2),
}


@pytest.mark.parametrize("dual", [False, True])
@pytest.mark.parametrize("key", ROBOSENSE)
def test_robosense_returns_lie_where_the_manual_says_by_the_angles_of_a_state_packet(key, dual):
    step_m, radius, height, block_us, fired_us, kind = ROBOSENSE[key]
    lasers = 16 if key in ("helios-16p", "rs-16") else 32
    # with two returns blocks come in pairs, but those of 16 lasers hold both
    halves, apart = dual and lasers == 16, 2 if dual and lasers == 32 else 1
    distances, intensities = values(12, 32)
    if key == "helios-16p":  # by which those of 16 lasers are told
        distances[:, 16:] = np.where(RNG.random((12, 16)) < 0.8, distances[:, :16] + 1, distances[:, 16:])
        intensities[:, 16:] = np.where(RNG.random((12, 16)) < 0.3, intensities[:, :16], intensities[:, 16:])
        distances[0, 16:], intensities[0, 16:] = distances[0, :16], intensities[0, :16]
    turn = 20 * (1 if halves else 2 if key == "rs-16" else 1)
    azimuths = [3000 + turn * (k // apart) for k in range(12)]
    block_us /= 1 + halves
    calendar = (23, 11, 14, 22, 13, 20) if key in ("bpearl", "rs-16", "rs-32") else None
    packet = build.robosense(azimuths, distances, intensities, time_us=123_456, kind=kind, calendar=calendar)
    elevations = np.round(RNG.permutation(np.linspace(-16, 15, lasers)), 2)
    offsets = np.round(RNG.uniform(-5, 5, lasers), 2)
    if key == "rs-16":
        elevations, offsets = np.array([*range(-15, 0, 2), *range(15, 0, -2)], float), np.zeros(16)
    mode = 0 if dual else 4
    state = build.robosense_state(elevations.tolist(), None if key == "rs-16" else offsets.tolist(), mode=mode)
    state = np.frombuffer(state, np.uint8)
    assert robosense.states(state[None]).tolist() == [True]
    recognised = robosense.recognise(np.frombuffer(packet, np.uint8)[None])
    assert recognised == key
    rings, expected = np.argsort(np.argsort(elevations)), []
    for block in range(12):
        for channel in range(32):
            metres, laser = distances[block][channel] * step_m, channel % lasers
            second = channel // 16 if halves else apart - 1 and block % 2
            other = (block, channel - 16) if halves else (block - 1, channel)
            if not metres or (second and all(one[block][channel] == one[other] for one in (distances, intensities))):
                continue
            after = fired_us(channel % 16 if halves else channel)
            turned = math.radians((azimuths[block] + turn * after / block_us) / 100)
            azimuth, elevation = turned + math.radians(offsets[laser]), math.radians(elevations[laser])
            level = metres * math.cos(elevation)
            x = level * math.cos(azimuth) + radius * math.cos(turned)
            y = -level * math.sin(azimuth) - radius * math.sin(turned)
            time = 1_700_000_000_123_456_000 + 1000 + round(1000 * block_us * (block // apart)) + round(1000 * after)
            row = (x, y, metres * math.sin(elevation) + height, time, rings[laser], intensities[block][channel])
            expected.append((*row, 1 + second))
    decoder = robosense.decoder_of(recognised, None, state)
    assert decoder.key == key
    agree(decoded(decoder, packet)[1], expected, tolerance=2e-4)
    if lasers == 16:  # without a state packet the times of packets tell
        steps = [round(12 * block_us) * k for k in range(3)]
        packets = [
            build.robosense(azimuths, distances, intensities, time_us=123_456 + step, kind=kind, calendar=calendar)
            for step in steps
        ]
        array = np.frombuffer(b"".join(packets), np.uint8).reshape(3, -1)
        points = robosense.RobosenseDecoder(key, decoder.angles_deg).points(
            array, np.zeros(3, np.int64), np.ones((3, 12), bool)
        )
        assert len(points) == 3 * len(expected)
        assert ("return_number" in points.extras) == dual
    with pytest.raises(DataError, match="no DIFOP packet"):
        robosense.decoder_of("helios-16p", None, state * 0)


@pytest.mark.parametrize("profile", sorted(set(ouster.PROFILES) - {"LEGACY"}))
def test_ouster_returns_lie_where_the_manual_says_in_each_profile(profile, tmp_path):
    metadata = ouster.read_metadata(build.ouster_metadata(tmp_path / "a.json", profile=profile))
    size = ouster.PROFILES[profile][0]
    words = RNG.integers(0, 256, (16, 4, size), np.uint8)
    columns = range(32, 48)
    packet = build.ouster(columns, words, size=size)
    assert len(packet) == metadata.length
    bits, returns = (15, 8) if "RNG15" in profile else (19, 1), 2 if "DUAL" in profile or "FIVE" in profile else 1
    expected = []
    for k, column in enumerate(columns):
        for row in range(4):
            pixel = words[k, row].tobytes()
            for number in range(returns):
                raw = struct.unpack_from("<I", pixel + bytes(4), 4 * number)[0]
                distance = (raw & ((1 << bits[0]) - 1)) * bits[1]
                reflectivity = pixel[4 * number + (2 if bits[0] == 15 else 3)]
                if bits[0] == 19 and returns == 1 and "RGB" not in profile:
                    reflectivity = pixel[4]
                encoder = 2 * math.pi * (1 - column / 64)
                azimuth = encoder - math.radians([3, 1, -1, -3][row])
                altitude, r = math.radians([10, 2, -3, -12][row]), (distance - 15.8) / 1000
                x = r * math.cos(azimuth) * math.cos(altitude) + 0.0158 * math.cos(encoder)
                y = r * math.sin(azimuth) * math.cos(altitude) + 0.0158 * math.sin(encoder)
                time = 10**12 + 100_000 * column + 1000
                if distance:
                    expected.append((-x, -y, r * math.sin(altitude) + 0.0382, time, row, reflectivity, number + 1))
    _, points = decoded(ouster.OusterDecoder(metadata), packet)
    agree(points, expected, tolerance=2e-4)  # up to 524 m in float32
    broken = bytearray(packet)
    broken[-1] = 1  # a checksum that does not hold
    survey = ouster.OusterDecoder(metadata).survey(np.frombuffer(bytes(broken), np.uint8)[None])
    assert not survey.usable.any()
