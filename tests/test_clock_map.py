import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusecap.live.devices.clock_map import BELIEVED, JUMP_NS, ClockMap

SHORTEST_S = 0.002


def stream(rate_hz, seconds, *, drift=0.0, start_s=1e6, seed=1):
    """Times of the samples, their stamps and arrivals; packets take 2 to 32 ms."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(int(rate_hz * seconds)) / rate_hz
    delay_s = SHORTEST_S + np.minimum(rng.exponential(0.006, len(t_s)), 0.03)
    return t_s, ns(start_s + t_s * (1 + drift)), ns(t_s + delay_s)


def ns(times_s):
    return [round(t * 1e9) for t in times_s]


def mapped_s(clock, stamps_ns, arrivals_ns):
    times = [clock.session_ns(s, a) for s, a in zip(stamps_ns, arrivals_ns, strict=True)]
    return np.array([np.nan if t is None else t * 1e-9 for t in times])


@pytest.mark.parametrize("rate_hz", [30, 60, 100])
@pytest.mark.parametrize("drift", [0.0, 1e-4, -1e-4, 1e-3])
def test_jitter_and_drift_are_taken_out_to_half_a_millisecond(rate_hz, drift):
    t_s, stamps, arrivals = stream(rate_hz, 40, drift=drift)
    clock = ClockMap()
    error_ms = 1e3 * (mapped_s(clock, stamps, arrivals) - t_s - SHORTEST_S)
    assert not np.isnan(error_ms).any() and clock.restarts == 0
    settled = np.abs(error_ms[10 * rate_hz :])
    assert np.percentile(settled, 95) < 0.6 and settled.max() < 1.5
    assert np.abs(error_ms).max() < 31.0


def test_one_wrong_stamp_moves_nothing():
    t_s, stamps, arrivals = stream(60, 20)
    stamps[900] += 150_000_000
    good = np.delete(np.arange(len(t_s)), slice(900, 912))
    error_ms = 1e3 * (mapped_s(ClockMap(), stamps, arrivals) - t_s - SHORTEST_S)
    assert np.nanmax(np.abs(error_ms[good][600:])) < 1.5


@pytest.mark.parametrize("step_s", [-5.0, -0.4, 0.4, 5.0, 1e9])
def test_clock_that_is_set_is_followed_after_a_few_samples(step_s):
    t_s, stamps, arrivals = stream(60, 20)
    stamps = stamps[:600] + [s + round(step_s * 1e9) for s in stamps[600:]]
    clock = ClockMap()
    times = mapped_s(clock, stamps, arrivals)
    assert clock.restarts == 1 and f"set by {step_s:+.1f} s" in clock.note
    left_out = np.flatnonzero(np.isnan(times))
    assert left_out[: BELIEVED - 1].tolist() == list(range(600, 600 + BELIEVED - 1))
    assert left_out.max() < 600 + 2 * BELIEVED
    error_ms = 1e3 * (times - t_s - SHORTEST_S)
    assert np.nanmax(np.abs(error_ms)) < 31.0
    assert np.abs(error_ms[-300:]).max() < 1.5


def test_single_stamps_far_off_are_left_out_and_no_jump():
    _, stamps, arrivals = stream(60, 10)
    for index in (100, 200, 300):
        stamps[index] += 3 * JUMP_NS
    clock = ClockMap()
    times = mapped_s(clock, stamps, arrivals)
    assert clock.restarts == 0
    assert np.flatnonzero(np.isnan(times)).tolist() == [100, 200, 300]


def test_burst_after_a_stall_keeps_its_own_times():
    t_s, stamps, arrivals = stream(60, 10)
    arrivals[300:360] = [max(a, arrivals[359]) for a in arrivals[300:360]]
    clock = ClockMap()
    error_ms = 1e3 * (mapped_s(clock, stamps, arrivals) - t_s - SHORTEST_S)
    assert clock.restarts == 0 and np.abs(error_ms[200:]).max() < 2.0


def test_clock_that_paused_is_followed_after_two_seconds():
    t_s, stamps, arrivals = stream(60, 10)
    arrivals = arrivals[:300] + [a + 500_000_000 for a in arrivals[300:]]
    clock = ClockMap()
    times = mapped_s(clock, stamps, arrivals)
    assert clock.restarts == 1 and "fell back by -0.5" in clock.note
    assert np.abs(times[-60:] - t_s[-60:] - 0.5 - SHORTEST_S).max() < 0.01


def test_late_and_double_samples_are_left_out():
    clock = ClockMap()
    given_ns = [clock.session_ns(s, 100 + s) for s in (0, 10, 10, 5, 20)]
    assert given_ns == [100, 110, None, None, 120]


def test_without_stamps_the_arrival_counts_less_the_stated_delay():
    clock = ClockMap(delay_s=0.04)
    assert clock.session_ns(None, 1_000_000_000) == 960_000_000
    assert clock.session_ns(None, 1_000_000_000) is None


def test_stamp_on_the_sessions_clock_is_taken_as_it_is_where_it_makes_sense():
    clock = ClockMap(delay_s=0.04)
    assert clock.session_ns(970, 1000, synchronised=True) == 970
    # Of the future: another clock.
    far_ns = 10**12
    assert clock.session_ns(far_ns, 10**9, synchronised=True) == 10**9 - 40_000_000


@given(
    st.lists(
        st.tuples(
            st.one_of(st.none(), st.integers(-(10**19), 10**19)),
            st.integers(0, 10**9),
            st.booleans(),
        ),
        max_size=200,
    )
)
@settings(max_examples=200, deadline=None)
def test_whatever_comes_times_ascend_and_are_not_of_the_future(samples):
    clock = ClockMap()
    arrival_ns, last_ns = 0, -(10**30)
    for stamp_ns, passed_ns, synchronised in samples:
        arrival_ns += passed_ns
        time_ns = clock.session_ns(stamp_ns, arrival_ns, synchronised=synchronised)
        if time_ns is not None:
            assert last_ns < time_ns <= arrival_ns
            last_ns = time_ns
