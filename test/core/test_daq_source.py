"""The source `daq`: with simulated devices, and with the real libraries where installed."""

import ctypes
import sys
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
from streamed import START, Streamed, source_of

from mr_damper_ros.rig.sources import daq_source
from mr_damper_ros.rig.sources.device_source import Portions

CHANNELS = {"displacement_channel": "ai0", "force_channel": "ai1"}
MCC = {"driver": "mcc", "displacement_channel": "3", "force_channel": "1"}


@pytest.fixture
def rig() -> Iterator[Callable[..., Streamed]]:
    made: list[Streamed] = []

    def make(**options: Any) -> Streamed:
        made.append(Streamed("daq", **options))
        return made[-1]

    yield make
    for each in made:
        each.source.close()


# -- any device --------------------------------------------------------------------------------


def test_volts_become_metres_newtons_and_amperes(rig: Callable[..., Streamed]) -> None:
    made = rig(displacement_scale=-0.001, force_scale=100.0, force_offset=7.0, current_scale=2.0)
    made.until(lambda: made.samples >= 300)
    # The simulated device gives 5 V and 7 V at 1 Hz, and a constant 1.5 V.
    phase = np.arcsin(made.joined("displacement") / -0.005)
    assert np.ptp(made.joined("displacement")) > 0.002
    expected = 7.0 + 700.0 * np.tanh(3.0 * np.abs(np.cos(phase)))
    np.testing.assert_allclose(np.abs(made.joined("force") - 7.0) + 7.0, expected, atol=1e-6)
    assert set(made.joined("current")) == {3.0}
    assert (np.diff(made.numbers()) == 1).all()
    assert {block.period for block in made.blocks} == {1e-3}


def test_a_channel_at_the_end_of_its_range_is_left_out_and_told(
    rig: Callable[..., Streamed],
) -> None:
    made = rig(force_range=6.0)
    made.until(lambda: np.diff(made.numbers()).max(initial=1) > 1)
    assert np.abs(made.joined("force")).max() < 6.0
    state = made.source.state()
    assert "the force is clipped at the end of its range of 6 V" in state.finding.sentence
    assert state.values["force at the end of its range"]
    assert state.values["displacement at the end of its range"] == 0


def fake_device(portions: list[Any]) -> Portions[Any]:
    """A device of two channels that yields these portions; an exception disconnects it."""
    yield None
    for portion in portions:
        if isinstance(portion, Exception):
            raise portion
        yield portion
    while True:
        yield None


def readings(first: int, count: int = 50) -> daq_source.Readings:
    ramp = 1e-6 * np.arange(first, first + count)
    return daq_source.Readings(np.stack([ramp, ramp]), 1000.0)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch, rig: Callable[..., Streamed]) -> Callable[..., Streamed]:
    """A rig whose device yields these portions, one list per connection."""

    def make(*connections: list[Any]) -> Streamed:
        turns = iter(connections)

        def read(library: None, channels: daq_source.DaqOptions) -> Portions[Any]:
            return fake_device(next(turns, []))

        monkeypatch.setitem(daq_source.DRIVERS, "labjack", daq_source.Driver(read))
        return rig(driver="labjack", **CHANNELS)

    return make


def test_a_device_that_is_lost_goes_on_after_a_gap(fake: Callable[..., Streamed]) -> None:
    made = fake([readings(0), OSError("the cable")], [readings(1000)])
    made.until(lambda: made.samples >= 100)
    steps = np.diff(made.numbers())
    # The source reconnects after half a second.
    assert steps.max() > 300
    assert np.count_nonzero(steps != 1) == 1
    times = [block.start_ns - START for block in made.blocks]
    assert times[5] - times[4] > 300_000_000


@pytest.mark.parametrize(
    ("options", "part"),
    [
        ({"driver": "nidaqmx"}, "daq.device is empty"),
        ({"driver": "labjack"}, "daq.displacement_channel is empty"),
        ({"driver": "nidaqmx", "device": "Dev1", "displacement_channel": "ai0"}, "daq.force_ch"),
        ({"force_scale": 0.0}, "daq.force_scale is 0"),
        (MCC | {"force_channel": "ai0"}, "MCC has no channel 'ai0'"),
        ({}, ""),
    ],
)
def test_what_is_missing_is_said(options: dict[str, Any], part: str) -> None:
    objection = source_of("daq", **options).settings.objection()
    assert part in objection
    assert bool(objection) == bool(part)


@pytest.mark.parametrize("driver", ["nidaqmx", "labjack", "mcc"])
def test_a_library_that_is_missing_is_one_sentence(
    driver: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = {"nidaqmx": "nidaqmx", "labjack": "labjack.ljm", "mcc": "uldaq"}[driver]
    monkeypatch.setitem(__import__("sys").modules, library, None)
    with pytest.raises(ValueError, match="is not installed: pip install"):
        source_of("daq", driver=driver, device="x", **CHANNELS).open()


# -- National Instruments ----------------------------------------------------------------------


def fake_ni(monkeypatch: pytest.MonkeyPatch, volts: np.ndarray) -> Any:
    """The real nidaqmx on a driver that yields these volts (2, n) and then disconnects."""
    nidaqmx = pytest.importorskip("nidaqmx")
    from nidaqmx._base_interpreter import BaseInterpreter

    class Interpreter(BaseInterpreter):
        def __init__(self) -> None:
            self.calls: list[tuple[Any, ...]] = []
            self.at = 0

        def create_task(self, name: str) -> tuple[str, bool]:
            return "task", True

        def internal_get_last_created_chan(self) -> str:
            raise NotImplementedError

        def create_ai_voltage_chan(self, task: str, *arguments: Any) -> None:
            self.calls.append(arguments)

        def cfg_samp_clk_timing(self, task: str, *arguments: Any) -> None:
            self.calls.append(arguments)

        def get_timing_attribute_double(self, task: str, attribute: int) -> float:
            return 999.5

        def get_task_attribute_string(self, task: str, attribute: int) -> str:
            return "task"

        def get_task_attribute_uint32(self, task: str, attribute: int) -> int:
            return 2

        def start_task(self, task: str) -> None:
            self.calls.append(("start",))

        def get_read_attribute_uint32(self, task: str, attribute: int) -> int:
            if attribute != 0x1223:
                return 2
            if self.at == volts.shape[1]:
                raise nidaqmx.DaqError("Device was unplugged.\n\nDevice: Dev1", -201003)
            return min(30, volts.shape[1] - self.at)

        def read_analog_f64(
            self, task: str, count: int, timeout: float, fill: int, into: np.ndarray
        ) -> tuple[np.ndarray, int]:
            into[:] = volts[:, self.at : self.at + count]
            self.at += count
            return into, count

        def clear_task(self, task: str) -> None:
            self.calls.append(("clear",))

    Interpreter.__abstractmethods__ = frozenset()
    made: list[Any] = []

    def interpreter(grpc_options: object = None) -> Any:
        if not made:
            made.append(Interpreter())
            return made[0]
        raise nidaqmx.DaqError("There is no such device.", -200220)

    monkeypatch.setattr(nidaqmx.utils, "_select_interpreter", interpreter)
    return made


NI = {"driver": "nidaqmx", "device": "Dev1", **CHANNELS}


def test_nidaqmx_reads_the_channels_of_a_task_until_the_device_is_gone(
    monkeypatch: pytest.MonkeyPatch, rig: Callable[..., Streamed]
) -> None:
    ramp = 1e-3 * np.arange(200)
    made = fake_ni(monkeypatch, np.stack([ramp, -ramp]))
    running = rig(**NI, displacement_scale=0.01, force_scale=1000.0, force_range=5.0)
    running.until(lambda: running.samples >= 200)
    np.testing.assert_allclose(running.joined("displacement"), 0.01 * ramp)
    np.testing.assert_allclose(running.joined("force"), -1000.0 * ramp)
    assert {block.period for block in running.blocks} == {1.0 / 999.5}
    running.until(lambda: "no such device" in running.fault)
    calls = made[0].calls
    constants = pytest.importorskip("nidaqmx.constants")
    volts = constants.VoltageUnits.VOLTS.value
    wiring = constants.TerminalConfiguration.DIFF.value
    assert calls[0] == ("Dev1/ai0", "", wiring, -10.0, 10.0, volts, "")
    assert calls[1] == ("Dev1/ai1", "", wiring, -5.0, 5.0, volts, "")
    assert (calls[2][0], calls[2][4]) == (1000.0, 10_000)
    assert calls[3:] == [("start",), ("clear",)]


# -- LabJack -----------------------------------------------------------------------------------


NO_SCANS_RETURNED = 1309


class FakeLjm:
    """LabJack's library as labjack-ljm calls it: a stream of two channels, then an error."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = iter(values.T.reshape(-1, 20, 2))
        self.written: dict[str, float] = {}
        self.gone = False
        self.idle = 0

    def LJM_OpenS(self, *arguments: Any) -> int:  # noqa: N802
        if self.gone:
            return 1227
        arguments[-1]._obj.value = 7
        return 0

    def LJM_eWriteNames(self, handle: int, count: Any, names: Any, values: Any, error: Any) -> int:  # noqa: N802
        for k in range(count.value):
            self.written[names._obj[k].decode()] = values._obj[k]
        return 0

    def LJM_WriteLibraryConfigS(self, name: bytes, value: Any) -> int:  # noqa: N802
        self.written[name.decode()] = value.value
        return 0

    def LJM_NamesToAddresses(self, count: Any, names: Any, addresses: Any, types: Any) -> int:  # noqa: N802
        for k in range(count.value):
            name = names._obj[k].decode()
            addresses._obj[k] = 2 * int(name[3:]) if name.startswith("AIN") else -1
        return 0

    def LJM_eStreamStart(self, *arguments: Any) -> int:  # noqa: N802
        arguments[-1]._obj.value = 1000.5
        return 0

    def LJM_eStreamRead(self, handle: int, data: Any, *backlogs: Any) -> int:  # noqa: N802
        values = next(self._values, None)
        if values is None:
            self.idle += 1
            self.gone = self.idle > 5
            return 1224 if self.gone else NO_SCANS_RETURNED
        data._obj[:] = values.ravel().tolist()
        return 0

    def LJM_eStreamStop(self, handle: int) -> int:  # noqa: N802
        return 0

    def LJM_Close(self, handle: int) -> int:  # noqa: N802
        return 0

    def LJM_ErrorToString(self, code: int, text: Any) -> None:  # noqa: N802
        pass


LABJACK = {"driver": "labjack", "displacement_channel": "AIN0", "force_channel": "AIN2"}


@pytest.mark.parametrize(("differential", "negative"), [(True, 3.0), (False, 199.0)])
def test_labjack_streams_its_channels_until_the_device_is_gone(
    monkeypatch: pytest.MonkeyPatch,
    rig: Callable[..., Streamed],
    differential: bool,
    negative: float,
) -> None:
    ljm = pytest.importorskip("labjack.ljm.ljm")
    ramp = 1e-3 * np.arange(200)
    values = np.stack([ramp, -ramp])
    values[1, 50] = -9999.0
    fake = FakeLjm(values)
    monkeypatch.setattr(ljm, "_staticLib", fake)
    running = rig(**LABJACK, force_range=1.0, differential=differential)
    running.until(lambda: running.samples >= 190)
    expected = np.delete(ramp, 50)
    np.testing.assert_allclose(running.joined("displacement"), expected[:190])
    assert {block.period for block in running.blocks} == {1.0 / 1000.5}
    assert running.source.state().values["without a value"] == 1
    assert fake.written["AIN0_RANGE"] == 10.0
    assert fake.written["AIN2_RANGE"] == 1.0
    assert fake.written["AIN2_NEGATIVE_CH"] == negative
    assert fake.written["LJM_STREAM_SCANS_RETURN"] == 2.0
    running.until(lambda: "1227" in running.fault)


@pytest.mark.parametrize(
    ("library", "channel", "fault"),
    [
        (FakeLjm(np.empty((2, 0))), "ai2", "it has no channel ai2"),
        (None, "AIN2", "LJM is not installed"),
    ],
)
def test_a_labjack_without_a_channel_or_its_library_is_told(
    monkeypatch: pytest.MonkeyPatch,
    rig: Callable[..., Streamed],
    library: FakeLjm | None,
    channel: str,
    fault: str,
) -> None:
    monkeypatch.setattr(pytest.importorskip("labjack.ljm.ljm"), "_staticLib", library)
    running = rig(**{**LABJACK, "force_channel": channel})
    running.until(lambda: fault in running.fault)


# -- Measurement Computing ---------------------------------------------------------------------


DEAD_DEVICE = 8


class FakeUl:
    """MCC's library as uldaq calls it: a scan into the given ring buffer, then an error."""

    def __init__(self, volts: np.ndarray) -> None:
        self._volts = volts
        self._done = 0
        self._ring = np.empty((0, 0))
        self.scan: tuple[Any, ...] = ()
        self.calls: list[str] = []
        self.gone = False

    def __getattr__(self, name: str) -> Callable[..., int]:
        """Any other function does nothing and reports success."""

        def function(*arguments: Any) -> int:
            self.calls.append(name)
            return 0

        return function

    def loaded(self) -> Any:
        """The functions as those of a loaded library: their argument types can be set."""

        class Library:
            def __getattr__(other, name: str) -> Callable[..., int]:  # noqa: N805
                function = partial(getattr(self, name))
                setattr(other, name, function)
                return function

        return Library()

    def ulGetDaqDeviceInventory(self, kind: int, found: Any, count: Any) -> int:  # noqa: N802
        count._obj.value = 0 if self.gone else 1
        found[0].product_name, found[0].unique_id = "USB-1608G", "01ABCDEF"
        return 0

    def ulCreateDaqDevice(self, descriptor: Any) -> int:  # noqa: N802
        return 1

    def ulDevGetInfo(self, handle: int, item: int, place: int, value: Any) -> int:  # noqa: N802
        value._obj.value = 1
        return 0

    def ulGetDaqDeviceDescriptor(self, handle: int, found: Any) -> int:  # noqa: N802
        found._obj.dev_interface = 1
        return 0

    def ulAIGetInfo(self, handle: int, item: Any, place: int, value: Any) -> int:  # noqa: N802
        of_item = {"NUM_CHANS_BY_MODE": 8, "NUM_DIFF_RANGES": 2, "DIFF_RANGE": (5, 6)[place % 2]}
        value._obj.value = of_item.get(item.name, 1)
        return 0

    def ulAInScan(self, handle: int, *arguments: Any) -> int:  # noqa: N802
        low, high, _, _, held, rate, _, _, ring = self.scan = arguments
        self._ring = np.frombuffer(ring).reshape(held, high - low + 1)
        rate._obj.value = 999.5
        return 0

    def ulAInScanStatus(self, handle: int, status: Any, transfer: Any) -> int:  # noqa: N802
        if self._done == self._volts.shape[1]:
            self.gone = True
            return DEAD_DEVICE
        until = min(self._done + 70, self._volts.shape[1])
        for k in range(self._done, until):
            self._ring[k % len(self._ring)] = self._volts[:, k]
        self._done = transfer._current_scan_count = until
        status._obj.value = 1
        return 0

    def ulGetErrMsg(self, code: Any, text: Any) -> int:  # noqa: N802
        text.value = b"Device no longer responding"
        return 0


@pytest.fixture
def fake_mcc(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[np.ndarray], FakeUl]]:
    """The real uldaq on a library that yields these volts (channels, n)."""
    if find_spec("uldaq") is None:
        pytest.skip("uldaq is not installed")

    def make(volts: np.ndarray) -> FakeUl:
        fake = FakeUl(volts)
        with monkeypatch.context() as loading:
            # uldaq loads the library when it is imported.
            loading.setattr(ctypes, "CDLL", lambda name: fake.loaded())
            import_module("uldaq")
        return fake

    yield make
    for name in [name for name in sys.modules if name.partition(".")[0] == "uldaq"]:
        del sys.modules[name]


def test_mcc_scans_from_the_lowest_to_the_highest_channel_until_the_device_is_gone(
    fake_mcc: Callable[[np.ndarray], FakeUl], rig: Callable[..., Streamed]
) -> None:
    ramp = 1e-3 * np.arange(200)
    fake = fake_mcc(np.stack([-ramp, np.zeros(200), ramp]))
    running = rig(**MCC, rate=15.0, displacement_range=4.0, force_range=5.0)
    running.until(lambda: running.samples >= 200)
    np.testing.assert_allclose(running.joined("displacement"), ramp)
    np.testing.assert_allclose(running.joined("force"), -ramp)
    assert {block.period for block in running.blocks} == {1.0 / 999.5}
    low, high, mode, span, held, _, option, flags, _ = fake.scan
    assert (low, high, mode.name, span.name) == (1, 3, "DIFFERENTIAL", "BIP5VOLTS")
    assert (held, option.name, flags.name) == (150, "CONTINUOUS", "DEFAULT")
    running.until(lambda: "no such device" in running.fault)
    assert fake.calls[-3:] == ["ulAInScanStop", "ulDisconnectDaqDevice", "ulReleaseDaqDevice"]


def test_what_an_mcc_device_does_not_have_is_told(
    fake_mcc: Callable[[np.ndarray], FakeUl], rig: Callable[..., Streamed]
) -> None:
    fake_mcc(np.zeros((2, 0)))
    for wrong, sentence in (
        ({"force_channel": "8"}, "it has no channel 8: 8 channels can be wired differentially"),
        ({"force_range": 20.0}, "it has no range of ±20 V; its ranges: ±5 V, ±10 V"),
        ({"device": "DEADBEEF"}, "there is no such device; found: USB-1608G (01ABCDEF)"),
    ):
        running = rig(**{**MCC, **wrong})
        running.until(lambda: sentence in running.fault)  # noqa: B023


def test_mcc_without_its_library_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    if find_spec("uldaq") is None:
        pytest.skip("uldaq is not installed")

    def none(name: str) -> None:
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(ctypes, "CDLL", none)
    with pytest.raises(ValueError, match="libuldaq"):
        source_of("daq", **MCC).open()
