"""Faults of recorded data are named, or mended and said, for dampers of several laws."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import known
import numpy as np
import pytest
from random_motion import BandLimitedRandom

import mr_damper_ros as mr
from mr_damper_ros.data_check.channels import SHARP, clipped_at, held_steps, spikes
from mr_damper_ros.data_check.findings import NOTE, REFUSE, WARN, Kind, Severity
from mr_damper_ros.data_check.recordings import check_run, require_units
from mr_damper_ros.data_check.samples import Samples, check_samples, check_window, drives
from mr_damper_ros.kinematics.periodic_motion import Kinematics
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.signals.recording import DEFAULT_START_NS, Recording, RecordingError

PERIOD = 1e-3
TIME = np.arange(6000) * PERIOD
LAWS = ("sigmoid", "bouc_wen", "series_springs")
NOISE, JITTER = 4.0, 1e-6
"""Noise of the load cell [N] and of the displacement [m]."""


def motion(name: str, seed: int) -> Kinematics:
    if name == "random":
        return BandLimitedRandom(4e-3, 0.3, 4.0, seed).at(TIME)
    rate = 2.0 * np.pi * {"slow": 1.0, "fast": 4.0}[name]
    size, angle = 8e-3, rate * TIME + seed
    sine, cosine = size * np.sin(angle), size * np.cos(angle)
    return Kinematics(sine, rate * cosine, -(rate**2) * sine)


@cache
def sound(law: str = "sigmoid", name: str = "slow", seed: int = 0) -> Samples:
    """Samples of a damper at 1 A with noise on both channels."""
    rng, moved = np.random.default_rng(seed), motion(name, seed)
    current = np.full(TIME.size, 1.0)
    window = Window.from_samples(moved.displacement, np.zeros(TIME.size), current, PERIOD)
    force = known.controllable(law).window_force(window)
    return Samples(
        moved.displacement + rng.normal(0.0, JITTER, TIME.size),
        force + rng.normal(0.0, NOISE, TIME.size),
        current,
        PERIOD,
    )


SOUND = [
    (law, name, seed) for law in LAWS for name in ("slow", "fast", "random") for seed in (0, 1)
]


def kinds(samples: Samples, **options: bool) -> dict[Kind, int]:
    """Severity of each finding that is more than a note, by kind."""
    found = check_samples(samples, **options).findings
    return {each.kind: each.severity for each in found if each.severity > NOTE}


@pytest.mark.parametrize(("law", "name", "seed"), SOUND)
def test_sound_data_are_left_alone(law: str, name: str, seed: int) -> None:
    given = sound(law, name, seed)
    checked = check_samples(given)
    assert kinds(given) == {}
    assert checked.samples is given


# -- refused -------------------------------------------------------------------------------------

Change = Callable[[Samples], Samples]


def scaled(channel: str, factor: float) -> Change:
    return lambda given: replace(given, **{channel: factor * getattr(given, channel)})


def clipped(low: float, high: float) -> Change:
    """The force limited at these quantiles."""

    def change(given: Samples) -> Samples:
        return replace(given, force=np.clip(given.force, *np.quantile(given.force, (low, high))))

    return change


REFUSED: dict[str, tuple[Change, Kind]] = {
    "displacement in mm": (scaled("displacement", 1e3), Kind.UNIT),
    "displacement in m read as mm": (scaled("displacement", 1e-3), Kind.UNIT),
    "force in kN": (scaled("force", 1e-3), Kind.UNIT),
    "force much too large": (scaled("force", 1e4), Kind.UNIT),
    "current in mA": (scaled("current", 1e3), Kind.UNIT),
    "force reversed": (scaled("force", -1.0), Kind.INVERTED),
    "displacement reversed": (scaled("displacement", -1.0), Kind.INVERTED),
    "no force": (scaled("force", 0.0), Kind.STUCK),
    "no motion": (scaled("displacement", 0.0), Kind.AT_REST),
    "exchanged": (
        lambda given: replace(
            given, displacement=1e-5 * given.force, force=1e5 * given.displacement
        ),
        Kind.SWAPPED,
    ),
}


@pytest.mark.parametrize("fault", REFUSED)
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", ["slow", "random"])
def test_a_fault_that_cannot_be_mended_is_refused_by_its_name(
    fault: str, law: str, name: str
) -> None:
    change, kind = REFUSED[fault]
    assert kinds(change(sound(law, name))) == {kind: REFUSE}


CLIPPED = {"10 %": (0.0, 0.9), "33 %": (0.0, 0.67), "42 %": (0.0, 0.58), "both": (0.2, 0.8)}


@pytest.mark.parametrize("part", CLIPPED)
@pytest.mark.parametrize(("law", "name", "seed"), SOUND)
def test_a_clipped_force_is_named_and_marked_unless_it_is_refused(
    part: str, law: str, name: str, seed: int
) -> None:
    given = sound(law, name, seed)
    changed = clipped(*CLIPPED[part])(given)
    checked = check_samples(changed)
    found = [f for f in checked.findings if f.kind is Kind.CLIPPED]
    assert len(found) == 1
    assert (found[0].severity is REFUSE) == (checked.clipped is None)
    if checked.clipped is not None:
        np.testing.assert_array_equal(checked.clipped, given.force != changed.force)


@pytest.mark.parametrize(
    ("limits", "refused"),
    [((0.0, 0.75), False), ((0.0, 0.65), True), ((0.2, 0.8), False), ((0.3, 0.7), True)],
)
def test_a_force_that_is_clipped_half_the_time_or_most_of_a_side_is_refused(
    limits: tuple[float, float], refused: bool
) -> None:
    expected = {Kind.CLIPPED: REFUSE} if refused else {}
    assert kinds(clipped(*limits)(sound())) == expected


@pytest.mark.parametrize("law", LAWS)
def test_a_fit_leaves_out_clipped_forces(law: str) -> None:
    given = sound(law, "random")
    found = mr.identify(recording(clipped(0.1, 0.85)(given)), model=law)
    assert Kind.CLIPPED in [each.kind for each in found.findings]
    window = Window.from_samples(given.displacement, given.force, given.current, PERIOD)
    error = found.parameter_set.window_force(window) - given.force
    assert np.std(error) < 0.03 * np.std(given.force)


def test_a_force_above_those_of_usual_dampers_is_warned_of() -> None:
    assert kinds(scaled("force", 500.0)(sound())) == {Kind.UNIT: WARN}


@pytest.mark.parametrize("step", [1.0, 3.0, 5.0])
def test_a_quantised_force_is_not_taken_for_clipped(step: float) -> None:
    # 16 bits over a load cell of 100 kN are 3 N.
    assert clipped_at(np.round(sound().force / step) * step) == []


@pytest.mark.parametrize("part", [0.05, 0.1, 0.2])
def test_a_crank_that_rests_at_dead_centre_is_not_taken_for_clipped(part: float) -> None:
    # It slows down, stops completely, and starts slowly.
    cycle = np.clip((TIME % 0.5) / 0.5 / (1.0 - part), 0.0, 1.0)
    displacement = 5e-3 * np.cos(2.0 * np.pi * cycle)
    assert clipped_at(displacement) == []
    assert [each.extreme for each in clipped_at(np.minimum(displacement, 4.8e-3))] == [4.8e-3]


@pytest.mark.parametrize("offset", [0.0, 10_000.0])
def test_a_reversed_sign_is_found_whatever_the_zero_of_the_load_cell(offset: float) -> None:
    run = known.run(current=1.0, samples=1000)
    assert not drives(run.velocity, offset + run.force)
    assert drives(run.velocity, offset - run.force)


# -- mended --------------------------------------------------------------------------------------

RESTORED = 0.02
"""Largest error of a mended channel, relative to the standard deviation of the channel."""


def hum(size: float, frequency: float) -> Change:
    def change(given: Samples) -> Samples:
        # The frequency of the mains and of a loose potentiometer wanders.
        phase = 2.0 * np.pi * np.cumsum(frequency + 0.5 * np.sin(3.0 * TIME)) * PERIOD
        return replace(given, displacement=given.displacement + size * np.sin(phase))

    return change


def with_spikes(channel: str, size: float, width: int) -> Change:
    def change(given: Samples) -> Samples:
        rng = np.random.default_rng(7)
        values = getattr(given, channel).copy()
        for place in rng.integers(10, values.size - 10, 25).tolist():
            values[place : place + width] += size * rng.choice([-1.0, 1.0])
        return replace(given, **{channel: values})

    return change


def held(channel: str, step: int) -> Change:
    def change(given: Samples) -> Samples:
        values = getattr(given, channel)
        return replace(given, **{channel: values[np.arange(values.size) // step * step]})

    return change


def with_glitches(given: Samples) -> Samples:
    current = given.current.copy()
    for place in (500, 2100, 4000):
        current[place : place + 20] = 0.0
    return replace(given, current=current)


MENDED: dict[str, tuple[Change, Kind, str]] = {
    "hum, 30 µm": (hum(3e-5, 51.0), Kind.HUM, "displacement"),
    "hum, 100 µm": (hum(1e-4, 100.0), Kind.HUM, "displacement"),
    "knocks on the load cell": (with_spikes("force", 900.0, 1), Kind.SPIKES, "force"),
    "longer knocks": (with_spikes("force", 900.0, 4), Kind.SPIKES, "force"),
    "a loose plug": (with_spikes("displacement", 8e-3, 2), Kind.SPIKES, "displacement"),
    "a slow sensor": (held("displacement", 20), Kind.HELD, "displacement"),
    "a slow load cell": (held("force", 5), Kind.HELD, "force"),
    "a meter that drops out": (with_glitches, Kind.SPIKES, "current"),
}


@pytest.mark.parametrize("fault", MENDED)
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", ["slow", "random"])
def test_what_can_be_mended_is_mended_and_said(fault: str, law: str, name: str) -> None:
    change, kind, channel = MENDED[fault]
    clean = sound(law, name)
    checked = check_samples(change(clean))
    assert [(f.kind, f.channel) for f in checked.findings if f.kind is kind] == [(kind, channel)]
    assert kinds(change(clean)) == {}
    for each in ("displacement", "force", "current"):
        left = getattr(checked.samples, each) - getattr(clean, each)
        size = max(float(np.std(getattr(clean, each))), 1.0 if each == "current" else 0.0)
        assert known.rms(left) < RESTORED * size + (2.0 * NOISE if each == "force" else 0.0)


@pytest.mark.parametrize("fault", MENDED)
def test_as_measured_a_fault_is_warned_of_and_nothing_is_changed(fault: str) -> None:
    change, kind, _ = MENDED[fault]
    faulty = change(sound())
    assert check_samples(faulty, mend=False).samples is faulty
    assert kinds(faulty, mend=False) == {kind: WARN}


@pytest.mark.parametrize("law", LAWS)
def test_a_motion_that_the_force_answers_is_no_hum(law: str) -> None:
    # A dither of 0.3 mm at 20 Hz on a slow sine of 8 mm.
    angle = 2.0 * np.pi * 20.0 * TIME
    displacement = sound().displacement + 3e-4 * np.sin(angle)
    window = Window.from_samples(displacement, np.zeros(TIME.size), 1.0, PERIOD)
    force = known.controllable(law).window_force(window)
    given = Samples(displacement, force, np.full(TIME.size, 1.0), PERIOD)
    assert kinds(given) == {}


def test_the_turns_of_a_force_are_no_spikes() -> None:
    force = sound(name="fast").force
    assert not spikes(force, 250.0, SHARP).any()


def test_a_coarse_displacement_is_not_taken_for_a_slow_one() -> None:
    assert held_steps(np.round(sound().displacement / 2e-4) * 2e-4) == 1


@pytest.mark.parametrize("step", [0.06, 0.3])
def test_a_current_that_is_commanded_has_no_glitches(step: float) -> None:
    # Small steps about one level, and larger ones for longer than a reading.
    current = 1.0 + step * np.repeat(np.random.default_rng(0).choice([-0.5, 0.0, 0.5], 60), 100)
    assert kinds(replace(sound(), current=current)) == {}


def test_the_slowest_disturbance_that_is_filtered_lies_above_the_motion() -> None:
    # Two tones of one slow motion; there is room between them, but no hum.
    time = np.arange(20_000) * 0.01
    displacement = 8e-3 * np.sin(0.3 * time) + 4e-4 * np.sin(2.0 * time)
    force = 800.0 * np.tanh(np.gradient(displacement, 0.01) / 1e-3)
    checked = check_samples(Samples(displacement, force, np.ones(time.size), 0.01))
    assert Kind.HUM not in [each.kind for each in checked.findings]


# -- time ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("early", [90, 120])
def test_a_hysteresis_that_runs_backward_is_warned_of(law: str, early: int) -> None:
    given = sound(law)
    shifted = replace(given, force=np.roll(given.force, -early))
    assert kinds(shifted) == {Kind.BACKWARD: WARN}


def test_an_early_force_of_inertia_is_not_taken_for_one_of_the_clock() -> None:
    given = sound(name="fast")
    acceleration = motion("fast", 0).acceleration
    assert kinds(replace(given, force=0.05 * given.force + 5.0 * acceleration)) == {}


# -- windows of a stream -------------------------------------------------------------------------


@pytest.mark.parametrize("fault", ["force in kN", "no force"])
def test_a_window_is_refused_for_what_cannot_be_mended(fault: str) -> None:
    change, kind = REFUSED[fault]
    refused = check_window(change(sound()), moves=True).refused
    assert refused is not None
    assert refused.kind is kind


def test_a_knock_in_a_window_is_bridged() -> None:
    knocked = with_spikes("force", 900.0, 3)(sound())
    checked = check_window(knocked, moves=True)
    assert checked.refused is None
    assert known.rms(checked.samples.force - sound().force) < 2.0 * NOISE


# -- runs ----------------------------------------------------------------------------------------


def recording(given: Samples, part: slice = slice(None), **changes: object) -> Recording:
    rows = given.displacement[part], given.force[part], given.current[part]
    return replace(Recording("run", DEFAULT_START_NS, given.period, *rows), **changes)


def test_fragments_shorter_than_a_cycle_are_left_out_and_said() -> None:
    whole, fragment = recording(sound()), recording(sound(), slice(100))
    checked = check_run([fragment, whole])
    assert len(checked.sections) == 1
    assert [(each.kind, each.severity) for each in checked.findings] == [(Kind.FRAGMENT, NOTE)]


@pytest.mark.parametrize("length", [30, 300])
def test_a_run_shorter_than_a_cycle_is_left_out_beside_a_whole_one(length: int) -> None:
    whole, fragment = recording(sound()), recording(sound(), slice(length), name="fragment")
    found = mr.identify(fragment, whole, method="least_squares")
    assert [run.name for run in found.runs] == ["run"]
    told = [(each.kind, each.severity, each.source) for each in found.findings]
    assert told == [(Kind.FRAGMENT, NOTE, "fragment")]


def test_as_measured_keeps_fragments() -> None:
    whole, fragment = recording(sound()), recording(sound(), slice(300))
    assert len(check_run([fragment, whole], mend=False).sections) == 2


def test_sections_that_all_hold_less_than_a_cycle_are_used_with_a_warning() -> None:
    pieces = [recording(sound(), slice(first, first + 400)) for first in (0, 1000)]
    checked = check_run(pieces)
    assert len(checked.sections) == 2
    assert Kind.SHORT in [each.kind for each in checked.findings]


@pytest.mark.parametrize(
    ("changes", "channel"),
    [
        ({"period": 1.0}, "time"),
        ({"period": 1e-7}, "time"),
        ({"temperature": np.full(TIME.size, 301.0)}, "temperature"),
    ],
)
def test_times_and_temperatures_in_a_wrong_unit_are_refused(
    changes: dict[str, object], channel: str
) -> None:
    with pytest.raises(RecordingError, match=f"the {channel} "):
        require_units(recording(sound(), **changes))


def test_a_slow_pull_gives_a_result_that_warns() -> None:
    time = np.arange(1000) * 0.02
    pulled = 1.6e-4 * time + 4e-7 * np.random.default_rng(0).normal(size=time.size)
    force = 400.0 * (1.0 - np.exp(-time / 3.0))
    found = mr.identify(displacement=pulled, force=force, current=0.0, period=0.02)
    assert Kind.SHORT in [each.kind for each in found.findings]
    assert not found.success


@pytest.mark.parametrize("lost", [20, 100])
def test_a_run_is_cut_where_samples_were_lost_without_a_gap_in_time(lost: int) -> None:
    given = sound(name="fast")
    kept = np.r_[0:1000, 1000 + lost : 3000, 3000 + lost : given.force.size]
    rows = [values[kept] for values in (given.displacement, given.force, given.current)]
    checked = check_samples(Samples(*rows, PERIOD))
    assert [(each.kind, each.severity) for each in checked.findings] == [(Kind.MISSING, NOTE)]
    ends = (1000, 3000 - lost, rows[0].size)
    assert checked.parts == tuple(map(slice, (0, *ends), ends))
    assert Kind.MISSING in kinds(Samples(*rows, PERIOD), mend=False)


@pytest.mark.parametrize("channel", ["displacement", "force"])
def test_a_stretch_in_which_a_channel_is_stuck_is_left_out(channel: str) -> None:
    given = sound(name="random")
    values = getattr(given, channel).copy()
    values[2000:2700] = values[2000]
    checked = check_samples(replace(given, **{channel: values}))
    assert {(each.kind, each.severity) for each in checked.findings} == {(Kind.STUCK, NOTE)}
    # A sample of chance repeats.
    assert [(part.start, part.stop) for part in checked.parts] == [(0, 2000), (2700, TIME.size)]


@pytest.mark.parametrize("name", ["slow", "fast"])
def test_a_displacement_that_is_clipped_for_a_moment_is_restored(name: str) -> None:
    given = sound(name=name)
    limit = float(np.quantile(given.displacement, 0.96))
    checked = check_samples(replace(given, displacement=given.displacement.clip(max=limit)))
    assert [(each.kind, each.severity) for each in checked.findings] == [(Kind.CLIPPED, NOTE)]
    restored = checked.samples.displacement - given.displacement
    assert np.max(np.abs(restored)) < 0.005 * np.ptp(given.displacement)


@pytest.mark.parametrize("step", [5e-5, 1e-4, 1.5e-4])
def test_a_coarse_displacement_is_not_taken_for_a_clipped_one(step: float) -> None:
    assert not clipped_at(np.round(sound().displacement / step) * step)


def test_samples_lost_all_the_time_are_warned_of() -> None:
    given = sound(name="fast")
    kept = np.arange(given.force.size) % 150 < 120
    rows = (values[kept] for values in (given.displacement, given.force, given.current))
    assert Kind.MISSING in kinds(Samples(*rows, PERIOD))


@pytest.mark.parametrize(("name", "lost", "said"), [("slow", 60, []), ("random", 250, [NOTE])])
def test_recorded_gaps_are_restored_if_they_are_short_and_cut_out_otherwise(
    name: str, lost: int, said: list[Severity]
) -> None:
    given = sound(name=name)
    gaps = (slice(1400, 1400 + lost), slice(3900, 3900 + lost))
    kept = np.ones(TIME.size, dtype=bool)
    for gap in gaps:
        kept[gap] = False
    values = {n: getattr(given, n) for n in ("displacement", "force", "current")}
    bridged = {n: np.interp(TIME, TIME[kept], each[kept]) for n, each in values.items()}
    found = mr.identify(Recording(name, DEFAULT_START_NS, PERIOD, **bridged, gaps=gaps))
    assert [each.severity for each in found.findings if each.kind is Kind.MISSING] == said
    assert sum(run.error.count for run in found.runs) == np.count_nonzero(kept)
    window = Window.from_samples(given.displacement, given.force, given.current, PERIOD)
    error = found.parameter_set.window_force(window) - given.force
    assert np.std(error) < 0.05 * np.std(given.force)


# -- causes of a poor fit ------------------------------------------------------------------------


@pytest.mark.parametrize(("law", "late"), [("sigmoid", -40), ("sigmoid", 40), ("bouc_wen", 40)])
def test_a_shift_of_the_force_in_random_motion_is_measured(law: str, late: int) -> None:
    given = sound(law, "random")
    found = mr.identify(recording(replace(given, force=np.roll(given.force, late))), model=law)
    skews = [each for each in found.findings if each.kind is Kind.SKEW]
    assert [each.severity for each in skews] == [WARN]
    assert abs(skews[0].value - late * PERIOD) < 3.0 * skews[0].error


@pytest.mark.parametrize(
    ("change", "kind"),
    [(lambda f: f + 400.0, Kind.ZERO_CHANGES), (lambda f: 1.4 * f, Kind.GAIN_CHANGES)],
)
def test_a_zero_or_a_gain_that_changes_at_once_is_named(
    change: Callable[[np.ndarray], np.ndarray], kind: Kind
) -> None:
    given = sound(name="random")
    half = given.force.size // 2
    force = np.concatenate((given.force[:half], change(given.force[half:])))
    found = mr.identify(recording(replace(given, force=force)))
    assert kind in [each.kind for each in found.findings]


def test_a_gain_that_changes_twice_is_named() -> None:
    given = sound(name="random")
    gain = np.select([TIME < 2.0, TIME < 4.5], [1.0, 0.7], 1.4)
    found = mr.identify(recording(replace(given, force=gain * given.force)))
    assert Kind.GAIN_CHANGES in [each.kind for each in found.findings]


@pytest.mark.parametrize(("zero", "severity"), [(250.0, [WARN]), (15.0, [])])
def test_a_zero_that_differs_between_runs_is_named(zero: float, severity: list[int]) -> None:
    runs = [
        recording(replace(sound(name=name), force=sound(name=name).force + offset), name=name)
        for name, offset in (("slow", 0.0), ("fast", zero), ("random", 0.0))
    ]
    found = [each for each in mr.identify(runs).findings if each.kind is Kind.ZERO_DIFFERS]
    assert [each.severity for each in found] == severity
    assert all(each.source == "fast" for each in found)


def test_a_steady_drift_is_no_step() -> None:
    given = sound(name="random")
    fading = np.linspace(1.0, 0.75, given.force.size)
    found = mr.identify(recording(replace(given, force=fading * given.force)))
    assert found.success


# -- the current ---------------------------------------------------------------------------------


def changing(late: int, seed: int = 0) -> mr.Recording:
    """Random motion with a current that steps between five values, recorded ``late`` samples."""
    rng = np.random.default_rng(seed)
    time = np.arange(20_000) * PERIOD
    moved = BandLimitedRandom(4e-3, 0.3, 4.0, seed).at(time)
    current = np.repeat(rng.choice([0.0, 0.4, 0.8, 1.2, 1.6], 100), 200)
    window = Window.from_samples(moved.displacement, np.zeros(time.size), current, PERIOD)
    force = mr.ParameterSet(THESIS_28_CELSIUS).window_force(window) + rng.normal(
        0.0, NOISE, time.size
    )
    return mr.Recording(
        "run", DEFAULT_START_NS, PERIOD, moved.displacement, force, np.roll(current, late)
    )


@pytest.mark.parametrize("late", [-80, -50, 50, 80])
def test_a_current_that_is_recorded_late_or_early_is_measured(late: int) -> None:
    found = mr.identify(changing(late))
    skews = [each for each in found.findings if each.kind is Kind.CURRENT_SKEW]
    assert [each.severity for each in skews] == [WARN]
    # [s]: half a step of the search, and the error of a set that was fitted to wrong currents.
    assert abs(skews[0].value + late * PERIOD) < 0.01
    assert not found.success


def test_a_current_on_time_is_not_warned_of() -> None:
    assert mr.identify(changing(0)).success


# -- the interface -------------------------------------------------------------------------------


def test_the_check_of_a_recording_says_the_gravest_first() -> None:
    faulty = with_spikes("force", 900.0, 1)(scaled("displacement", -1.0)(sound()))
    found = mr.check(recording(faulty))
    assert found.severity is REFUSE
    assert [each.severity for each in found.findings] == sorted(
        (each.severity for each in found.findings), reverse=True
    )


@pytest.mark.parametrize("accept", [False, True])
def test_a_warning_is_no_success_unless_it_is_accepted(accept: bool) -> None:
    given = sound()
    shifted = recording(replace(given, force=np.roll(given.force, -90)))
    found = mr.identify(shifted, method="least_squares", accept_doubtful=accept)
    assert Kind.BACKWARD in [each.kind for each in found.findings]
    assert found.success is accept
    assert found.document()["findings"][0]["severity"] == "warn"


def test_another_law_that_explains_a_poor_fit_is_named() -> None:
    given = sound("bouc_wen", "random")
    found = mr.identify(recording(given), model="bingham")
    named = [each for each in found.findings if each.kind is Kind.OTHER_LAW]
    assert len(named) == 1
    assert "bouc_wen" in named[0].sentence or "series_springs" in named[0].sentence
