"""The simulated receiver: what it measures against the truth that it was made from."""

from itertools import islice
from typing import Any

import numpy as np
import pytest

from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch
from rtkmesh.gnss.signals import ATTRIBUTES, GLONASS, SATELLITES_PER_SYSTEM, carrier_hz, satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.geometry import line_of_sight
from rtkmesh.models.orbit import STATE, STATE_CLOCK, satellite_state
from rtkmesh.simulation.receiver import Observed, Receiver, ReceiverClock, ReceiverOptions
from rtkmesh.simulation.scenario import open_stream
from rtkmesh.simulation.sky import SATELLITES, Sky, glonass_generation
from rtkmesh.simulation.tracking import SignalOptions
from rtkmesh.simulation.trajectories import AntennaPath, Site, static

START = GpsTime(2445, 529200.0 + 3600.0)
SITE = Site(0.9, 0.2, 50.0)
QUIET = SignalOptions(
    code_sigma_m=0.0, phase_sigma_m=0.0, rate_sigma_mps=0.0, code_multipath_m=0.0, phase_multipath_m=0.0, glonass_code_bias_m=0.0,
    slips_per_hour=0.0, half_cycle_share=0.0,
)  # fmt: skip


def receiver(name: str = "a", offset: tuple[float, float, float] = (0.0, 0.0, 0.0), *, seed: int = 1, **options: Any) -> Receiver:
    return Receiver(name, AntennaPath(SITE, static, offset), seed, ReceiverOptions(**options))


def run(simulated: Receiver, seconds: float, step_s: float = 1.0, start: GpsTime = START) -> list[Observed]:
    return [simulated.observe(start + step_s * k) for k in range(round(seconds / step_s) + 1)]


def key(epoch: Epoch) -> np.ndarray:
    return epoch.satellite.astype(int) * 512 + epoch.signal


def wavelengths_m(epoch: Epoch) -> np.ndarray:
    rows = zip(epoch.satellite.tolist(), epoch.signal.tolist(), epoch.channel.tolist(), strict=True)
    return np.array([SPEED_OF_LIGHT_MPS / carrier_hz(*row) for row in rows])


def geometric_m(observed: Observed, position_ecef_m: np.ndarray) -> np.ndarray:
    """Range minus satellite clock per row at the true time, worked out apart from the simulator's own loop."""
    rows, time, out = Sky().rows(observed.true_time), observed.true_time, np.empty(len(observed.epoch))
    state, geometry = np.empty(STATE), np.empty(8)
    for k, satellite in enumerate(observed.epoch.satellite):
        row, travel_s = rows[int(np.flatnonzero(satellite == SATELLITES)[0])], 0.075
        for _ in range(6):
            satellite_state(row, time.week, time.tow_s - travel_s, state)
            line_of_sight(state, position_ecef_m, geometry)
            travel_s = geometry[0] / SPEED_OF_LIGHT_MPS
        out[k] = geometry[0] - SPEED_OF_LIGHT_MPS * state[STATE_CLOCK]
    return out


def test_double_differenced_phases_are_integers_and_codes_are_geometry():
    """10 m apart, without noise: whatever is common cancels, what is left are integer cycles and no code at all."""
    first, second = receiver("a", signals=QUIET), receiver("b", (10.0, 0.0, 0.0), signals=QUIET, clock_drift=-2e-7)
    one, two = first.observe(START), second.observe(START)
    assert np.array_equal(key(one.epoch), key(two.epoch))
    gone = [geometric_m(o, o.position_ecef_m) for o in (one, two)]
    code = (two.epoch.pseudorange_m - gone[1]) - (one.epoch.pseudorange_m - gone[0])
    wavelength = wavelengths_m(one.epoch)
    phase = (two.epoch.phase_cyc - gone[1] / wavelength) - (one.epoch.phase_cyc - gone[0] / wavelength)
    # the receivers' clocks differ by up to a millisecond: remove them by what the codes of the same signal say
    for system, signal in {
        (s // SATELLITES_PER_SYSTEM, g) for s, g in zip(one.epoch.satellite.tolist(), one.epoch.signal.tolist(), strict=True)
    }:
        rows = (one.epoch.satellite // SATELLITES_PER_SYSTEM == system) & (one.epoch.signal == signal)
        assert np.ptp(code[rows]) < 2e-3
        clock = np.mean(code[rows])
        double = (phase[rows] - clock / wavelength[rows]) - (phase[rows] - clock / wavelength[rows])[0]
        if system != GLONASS:  # (the offset that is common in metres is not in cycles there)
            assert np.abs(double - np.rint(double)).max() < 0.01
        assert np.any(np.abs(double) > 1.0)


def test_glonass_has_a_slope_on_each_band():
    """Codes and phases of GLONASS are later by the channel times the slope of their band, and no others."""
    slopes_m = 0.02, 0.015
    straight, sloped = (receiver(signals=QUIET._replace(glonass_slopes_m=s)).observe(START).epoch for s in ((0.0, 0.0), slopes_m))
    glonass, band = straight.satellite // SATELLITES_PER_SYSTEM == GLONASS, straight.signal // ATTRIBUTES
    late_m = np.where(glonass, straight.channel * np.where(band == 1, *slopes_m), 0.0)
    assert len(set(late_m[glonass])) > 8
    assert sloped.pseudorange_m - straight.pseudorange_m == pytest.approx(late_m, abs=1e-7)
    assert (sloped.phase_cyc - straight.phase_cyc) * wavelengths_m(straight) == pytest.approx(late_m, abs=1e-7)


def test_pseudoranges_are_truth_within_delays_and_noise():
    """Above 40 degrees, codes minus geometry are a few metres of atmosphere, delays and noise."""
    observed = receiver(clock_drift=0.0, steered=True).observe(START)
    excess = observed.epoch.pseudorange_m - geometric_m(observed, observed.position_ecef_m)
    high = observed.elevation_rad > 0.7
    assert np.sum(high) > 10
    assert np.all((excess[high] > -15.0) & (excess[high] < 45.0))


def test_doppler_is_the_rate_of_the_phase():
    """Phase differences over 0.2 s agree with the mean Doppler to 1 mm/s, at the horizon to 8 (the ionosphere's rate is not in it)."""
    simulated = receiver(signals=QUIET)
    a, _, b = run(simulated, 0.2, 0.1)
    assert np.array_equal(key(a.epoch), key(b.epoch))
    rate = (b.epoch.phase_cyc - a.epoch.phase_cyc) / 0.2
    error_mps = np.abs((rate + (a.epoch.doppler_hz + b.epoch.doppler_hz) / 2.0) * wavelengths_m(a.epoch))
    assert error_mps[a.elevation_rad > 0.7].max() < 1e-3
    assert error_mps.max() < 8e-3


def test_code_and_phase_change_alike():
    """Over a minute code minus phase drifts only by the ionosphere (decimetres at the horizon, on the second frequency)."""
    first, *_, last = run(receiver(signals=QUIET), 60.0, 5.0)
    common, i, j = np.intersect1d(key(first.epoch), key(last.epoch), return_indices=True)
    divergence = [o.epoch.pseudorange_m[k] - o.epoch.phase_cyc[k] * wavelengths_m(o.epoch)[k] for o, k in ((first, i), (last, j))]
    assert len(common) > 50
    assert np.abs(divergence[1] - divergence[0]).max() < 0.6


def test_noise_has_the_size_that_the_receiver_reports():
    """Code and phase noise at known truth, by sigma: variance of the normalised single differences of two epochs near 2."""
    options = QUIET._replace(code_sigma_m=0.25, phase_sigma_m=0.001)
    noisy, exact = receiver(signals=options), receiver(signals=QUIET)
    code: list[float] = []
    phase: list[float] = []
    for one, two in zip(run(noisy, 20.0), run(exact, 20.0), strict=True):
        assert np.array_equal(key(one.epoch), key(two.epoch))
        code += ((one.epoch.pseudorange_m - two.epoch.pseudorange_m) / one.epoch.pseudorange_sigma_m).tolist()
        phase += ((one.epoch.phase_cyc - two.epoch.phase_cyc) / one.epoch.phase_sigma_cyc).tolist()
    assert np.std(code) == pytest.approx(1.0, abs=0.05)
    assert np.std(phase) == pytest.approx(1.0, abs=0.05)


def test_multipath_is_coloured():
    """Errors 4 s apart hang together, errors two minutes apart do not."""
    options = QUIET._replace(code_multipath_m=1.0)
    pairs = [
        one.epoch.pseudorange_m - two.epoch.pseudorange_m
        for one, two in zip(run(receiver(signals=options), 240.0, 4.0), run(receiver(signals=QUIET), 240.0, 4.0), strict=True)
        if len(one.epoch) == len(two.epoch)
    ]
    count = min(map(len, pairs))
    assert count > 50
    errors = np.array([p[:count] for p in pairs])
    errors /= errors.std(axis=0)
    assert np.mean(errors[1:] * errors[:-1]) > 0.75
    assert abs(np.mean(errors[30:] * errors[:-30])) < 0.4


def test_cn0_grows_with_elevation_and_noise_falls():
    """High satellites are received better."""
    observed = receiver().observe(START)
    low, high = observed.elevation_rad < 0.4, observed.elevation_rad > 0.8
    assert observed.epoch.cn0_dbhz[high].mean() > observed.epoch.cn0_dbhz[low].mean() + 5.0
    assert observed.epoch.pseudorange_sigma_m[high].mean() < observed.epoch.pseudorange_sigma_m[low].mean()


def test_slips_change_the_ambiguity_and_are_told():
    """With many slips every change of the integer goes with SLIP and a lock time of 0, and there is none without."""
    slipping = receiver(signals=QUIET._replace(slips_per_hour=60.0))
    steady = receiver(signals=QUIET)
    slips, last = 0, np.array([])
    for one, two in zip(run(slipping, 60.0), run(steady, 60.0), strict=True):
        assert np.array_equal(key(one.epoch), key(two.epoch))
        offset = one.epoch.phase_cyc - two.epoch.phase_cyc
        if len(last) == len(offset):
            changed = np.abs(offset - last) > 0.25
            told = (one.epoch.flags & SLIP) != 0
            assert np.array_equal(changed, told)
            assert np.all(one.epoch.lock_s[told] == 0.0)
            assert np.abs(offset - np.rint(offset)).max() < 1e-3
            slips += int(told.sum())
        last = offset
    assert 30 < slips < 140


def test_half_cycles_are_wrong_until_they_are_resolved():
    """While HALF_CYCLE is set the phase may be off by half a cycle; afterwards it never is, and UBX says what was subtracted."""
    options = QUIET._replace(half_cycle_share=1.0, half_cycle_time_s=3.0, acquisition_time_s=1.0)
    cold, steady = receiver(signals=options, warm=False), receiver(signals=QUIET)
    unresolved = resolved = 0
    for one, two in zip(run(cold, 15.0), run(steady, 15.0), strict=True):
        _, i, j = np.intersect1d(key(one.epoch), key(two.epoch), return_indices=True)
        part = (one.epoch.phase_cyc[i] - two.epoch.phase_cyc[j]) % 1.0
        flagged = (one.epoch.flags[i] & HALF_CYCLE) != 0
        assert np.abs(part[flagged] - 0.5).max(initial=0.0) < 1e-3
        assert np.abs((part[~flagged] + 0.5) % 1.0 - 0.5).max(initial=0.0) < 1e-3
        assert np.array_equal(one.half_cycle_subtracted, (one.epoch.flags & HALF_CYCLE) == 0)
        unresolved, resolved = unresolved + int(flagged.sum()), resolved + int((~flagged).sum())
    assert unresolved > 100
    assert resolved > 500


def test_a_cold_receiver_acquires_bit_by_bit_and_a_warm_one_at_once():
    """Nothing at first, all after ten seconds; the first frequency comes before the second."""
    cold, warm = run(receiver(warm=False), 10.0), receiver().observe(START)
    assert [len(cold[0].epoch), len(cold[-1].epoch)] == [0, pytest.approx(len(warm.epoch), abs=2)]
    assert warm.epoch.lock_s.min() > 1.0
    assert 0 < len(cold[2].epoch) < len(cold[4].epoch) <= len(cold[10].epoch)


def test_clock_jumps_by_a_millisecond_and_says_so():
    """The reading stays within half a millisecond; at a jump codes and phases move by c times 1 ms together."""
    clock = ReceiverClock(3e-6, steered=False, rng=np.random.default_rng(1))
    offsets = [clock.offset(10.0 * k) for k in range(200)]
    assert max(abs(o[0]) for o in offsets) <= 0.5e-3
    assert offsets[-1][2] - offsets[0][2] == pytest.approx(200 * 10.0 * 3e-6 / 1e-3, abs=1.0)
    simulated = receiver(signals=QUIET, clock_drift=2e-5)
    observed = run(simulated, 60.0)
    jumps = [k for k in range(1, len(observed)) if observed[k].clock_reset]
    assert len(jumps) in (1, 2)
    before, after = observed[jumps[0] - 1].epoch, observed[jumps[0]].epoch
    _, i, j = np.intersect1d(key(before), key(after), return_indices=True)
    moved = after.pseudorange_m[j] - before.pseudorange_m[i]
    expected = -(before.doppler_hz[i] + after.doppler_hz[j]) / 2.0 * wavelengths_m(before)[i] - 1e-3 * SPEED_OF_LIGHT_MPS
    assert np.abs(moved - expected).max() < 1.0
    assert np.abs((after.phase_cyc[j] - before.phase_cyc[i]) * wavelengths_m(before)[i] - expected).max() < 1.0


def test_the_base_clock_is_steered():
    """Its reading is within 100 ns of GPS time."""
    stream = open_stream("demo", "base", seed=1, rate_hz=1.0, start=START)
    simulated = stream.receiver()
    for tag in islice(stream.tags(), 3):
        assert abs(simulated.observe(tag).true_time - tag) < 1e-7


def test_random_numbers_belong_to_seed_antenna_and_time():
    """Equal for equal seed and name, different when one of them differs."""
    one, again, seeded, named = (
        receiver(name, seed=seed, signals=QUIET._replace(code_sigma_m=1.0)).observe(START)
        for name, seed in (("a", 1), ("a", 1), ("a", 2), ("b", 1))
    )
    assert np.array_equal(one.epoch.pseudorange_m, again.epoch.pseudorange_m)
    assert not np.array_equal(one.epoch.cn0_dbhz, seeded.epoch.cn0_dbhz)
    assert not np.array_equal(one.epoch.cn0_dbhz, named.epoch.cn0_dbhz)


def test_an_outage_ends_all_arcs():
    """In the dive nothing is seen while submerged, and afterwards every arc is new."""
    stream = open_stream("dive", "rover", seed=3, rate_hz=0.5, start=START)
    simulated = stream.receiver()
    observed = [simulated.observe(tag) for tag in islice(stream.tags(), 65)]
    counts = [len(o.epoch) for o in observed]
    dark = [k for k, count in enumerate(counts) if count == 0]
    assert 7 <= len(dark) <= 16
    end = max(k for k in dark if k + 4 < len(counts))
    back = next(o for o in observed[end + 1 :] if len(o.epoch))
    assert np.all(back.epoch.lock_s < 2.1)
    assert np.all(back.epoch.flags & SLIP)


def test_glonass_is_acquired_anew_when_its_orbits_start_anew():
    """At the weekly change no GLONASS arc goes on; GPS arcs do."""
    change = GpsTime(2445, 529200.0 + 18.0)
    simulated = receiver(clock_drift=0.0, steered=True)
    observed = [simulated.observe(change + s) for s in (-1.0, 1.0)]
    assert glonass_generation(change + -1.0) != glonass_generation(change + 1.0)
    systems = [o.epoch.satellite // SATELLITES_PER_SYSTEM for o in observed]
    assert np.sum(systems[0] == GLONASS) > 4
    assert np.sum(systems[1] == GLONASS) == 0
    assert np.sum(systems[1] == 0) == np.sum(systems[0] == 0)


def test_epochs_are_sorted_and_satellites_have_the_signals_of_an_f9():
    """Rows are in the order of (satellite, signal); satellites of the older GPS blocks have no L2C."""
    epoch = receiver().observe(START).epoch
    assert np.all(np.diff(key(epoch)) > 0)
    codes = {(s // SATELLITES_PER_SYSTEM, g) for s, g in zip(epoch.satellite.tolist(), epoch.signal.tolist(), strict=True)}
    names = {0: ("1C", "2L"), 1: ("1C", "2C"), 2: ("1C", "7Q"), 3: ("2I", "7I")}
    assert codes == {(system, signal_number(code)) for system, pair in names.items() for code in pair}
    l2c = set(epoch.satellite[epoch.signal == signal_number("2L")].tolist())
    assert satellite_number("G16") not in l2c
