"""The page in a headless Chromium: figures, texts, keys, themes, small screens."""

import json
import re
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
import running_damper
from browser import PATIENCE, Browser
from waiting import until

from mr_damper_ros.live.live_record import HISTORY, Concern, LiveRecord, _joined_ranges
from mr_damper_ros.live.page_server import PAGE, PageServer
from mr_damper_ros.tools import live, watch
from mr_damper_ros.tools.live import empty_record, replay_into

SECONDS = 12


class GoingOn:
    """A record that receives 0.1 s of signals, and diagnostics, ten times per second."""

    def __init__(self) -> None:
        self.record = running_damper.running(SECONDS)
        self._time = float(SECONDS)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.1):
            running_damper.show_signals(self.record, self._time, 0.1)
            running_damper.show_health(self.record)
            self._time += 0.1

    def close(self) -> None:
        self._stop.set()
        self._thread.join()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser() as made:
        yield made


@pytest.fixture(scope="module")
def record() -> Iterator[LiveRecord]:
    with closing(GoingOn()) as stream:
        yield stream.record


def leave(browser: Browser) -> None:
    """Leave the page, so that it sends no further requests."""
    browser.open("about:blank")
    browser.until("location.href === 'about:blank'")


@contextmanager
def opened(browser: Browser, record: LiveRecord, *served: Any) -> Iterator[str]:
    """Open the page of a record, yield its address, and leave the page at the end."""
    leave(browser)  # an earlier page may still report what it requested
    browser.errors.clear()
    browser.requested.clear()
    with closing(PageServer(record, "127.0.0.1", 0, *served)) as server:
        browser.open(server.address)
        try:
            yield server.address
        finally:
            leave(browser)


@pytest.fixture
def page(browser: Browser, record: LiveRecord) -> Iterator[Browser]:
    """The live page; fails if the page has reported an error at the end."""
    browser.resize(1280, 900)
    browser.prefer("light")
    with opened(browser, record, "/") as address:
        browser.until("document.querySelector('#state')?.innerText.includes('live')")
        browser.until("document.querySelectorAll('figure canvas').length >= 35")
        yield browser
        assert browser.errors == []
        assert {urlsplit(url).netloc for url in browser.requested} == {urlsplit(address).netloc}


def ink(page: Browser, chart: str) -> str:
    """Content of a figure, as a text that changes with it."""
    return page.evaluate(f"document.querySelector('{chart} canvas').toDataURL()")


def texts(page: Browser, selector: str) -> list[str]:
    """Texts of all these elements."""
    return page.evaluate(f"[...document.querySelectorAll('{selector}')].map(e => e.innerText)")


def pixels(chart: str, colour: str) -> str:
    """JavaScript expression for the number of pixels of a figure with a colour."""
    return f"""(() => {{
      const canvas = document.querySelector('[data-chart="{chart}"] canvas');
      if (!canvas) return 0;
      const bits = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
      return Array.from({{ length: bits.length / 4 }}, (_, k) => bits.slice(4 * k, 4 * k + 4))
        .filter(([red, green, blue, opacity]) => opacity > 0 && {colour}).length;
    }})()"""


def test_figures_tiles_windows_and_diagnostics_are_shown(page: Browser) -> None:
    names = page.evaluate("[...document.querySelectorAll('figure canvas')].length")
    # Twelve named values, seven coefficients, sixteen parameters.
    assert names == 12 + 7 + 16
    for chart in ("force-velocity", "force-displacement", "force-time"):
        blue = page.evaluate(pixels(chart, "blue > red + 100"))
        orange = page.evaluate(pixels(chart, "red > blue + 100"))
        assert min(blue, orange) > 50, f"{chart}: measured and predicted are drawn"
    assert page.text("#tile-prediction").split() == ["✓", "valid"], "one error, in its own tile"
    assert page.text("#tile-scale").split() == ["0.952", "±", "0.003"]
    assert re.search("(?s)^5 mm, 1.5 Hz.*commanded 5 mm, 1.5 Hz", page.text("#tile-motion"))
    assert page.text("#tile-supply").split("\n") == ["0.503 A", "set 0.5 A; output on"]
    assert "200 N desired" in page.text("#tile-controller")
    assert "run 3" in page.text("#tile-campaign")
    assert page.text("#tile-current") == "0.5 A"
    assert f"nelder_mead-{SECONDS - 1}" in page.text("#tile-set")
    assert page.text("#tile-latency").startswith("0.612 ms")
    assert page.text("#tile-lost").startswith("3")
    assert page.text("#tile-error").split()[1] == "%"
    coefficient = page.text('#coefficients [data-name="f_t"] figcaption')
    assert coefficient.split() == ["f_t", "590.2", "±", "12", "N"]
    assert re.search("(?s)±.*N$", page.text('#parameters [data-name="f0"] figcaption'))
    assert page.text('#parameters [data-name="k6"] figcaption').endswith("not determined")
    rows = texts(page, "#window-rows tr")
    assert len(rows) == SECONDS - 1
    assert "✕ disturbed" in rows[0]
    assert "a hammer blow" in rows[0]
    assert "✓ accepted" in rows[1]
    shown = page.text("#concerns")
    assert "✕ error: the state cannot be kept" in shown
    assert "▲ warning: 3 samples were lost" in shown
    assert "✓ good: window 40% full" in shown


def place_of(page: Browser, chart: str, across: float) -> tuple[float, float]:
    """Screen position of a point of a figure, as a fraction of its width."""
    return page.evaluate(
        f"""(() => {{
          const over = document.querySelector('[data-chart="{chart}"] .u-over');
          over.scrollIntoView({{ block: 'center', behavior: 'instant' }});
          const box = over.getBoundingClientRect();
          return [box.x + {across} * box.width, box.y + box.height / 2];
        }})()"""
    )


@pytest.mark.parametrize(
    ("chart", "shown"),
    [("force-time", r"-?[\d.]+ / -?[\d.]+ N at .* s"), ("force-velocity", r"\S+ N at \S+ m/s")],
)
def test_a_figure_says_the_values_under_the_pointer(page: Browser, chart: str, shown: str) -> None:
    figure = f"[data-chart={chart}]"
    x, y = place_of(page, chart, 0.5)
    for at in (x - 3, x):
        page.send("Input.dispatchMouseEvent", type="mouseMoved", x=at, y=y)
    pattern = f"new RegExp({json.dumps(f'^{shown}$')})"
    page.until(f"{pattern}.test(document.querySelector('{figure} output').value)")


def test_an_outlier_does_not_flatten_a_figure(browser: Browser) -> None:
    record = running_damper.running(3)
    running_damper.add_signals(
        record, running_damper.START + 3.0, 0.0, 0.0, 0.5, 1e6, 0.0, valid=True
    )
    running_damper.show_signals(record, 3.01, 1.0)
    with opened(browser, record):
        output = "document.querySelector('[data-chart=force-time] output')"
        browser.until(f"{output}?.value === '1 outside the view'")


def drag(page: Browser, chart: str, begin: float, end: float, down: float = 0.0) -> None:
    """Drag from one point of a figure to another; click if the two are equal."""
    first, last = place_of(page, chart, begin), place_of(page, chart, end)
    held = {"button": "left", "buttons": 1, "clickCount": 1}
    page.send("Input.dispatchMouseEvent", type="mouseMoved", x=first[0], y=first[1])
    page.send("Input.dispatchMouseEvent", type="mousePressed", x=first[0], y=first[1], **held)
    if begin != end:
        middle = 0.5 * (first[0] + last[0])
        page.send("Input.dispatchMouseEvent", type="mouseMoved", x=middle, y=last[1], **held)
    at = {"x": last[0], "y": last[1] + down}
    page.send("Input.dispatchMouseEvent", type="mouseMoved", **at, **held)
    page.send("Input.dispatchMouseEvent", type="mouseReleased", **at, **held)


def wheel(page: Browser, chart: str, amount: float, *, sideways: bool = False) -> None:
    x, y = place_of(page, chart, 0.5)
    turned = {"deltaX": amount, "deltaY": 0} if sideways else {"deltaX": 0, "deltaY": amount}
    page.send("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, **turned)


NEWEST = "document.querySelector('[data-do=newest]')"
RUN = running_damper.running(120)
"""Two minutes; the page has only the signals of the last one."""


@pytest.fixture
def whole(browser: Browser) -> Iterator[Browser]:
    """The page of a run that does not advance."""
    with opened(browser, RUN):
        browser.until("document.querySelectorAll('[data-chart=run] canvas').length")
        browser.until("document.querySelectorAll('[data-chart=force-time] canvas').length")
        yield browser
        assert browser.errors == []


def first_and_last_time(page: Browser) -> tuple[float, float]:
    """Time range of the figures, read from the cursors at both edges."""
    page.until("document.querySelectorAll('[data-chart=force-time] .u-over').length")
    for _ in range(50):  # a message above the figures may move them between the clicks
        page.press("Escape")
        drag(page, "force-time", 0.002, 0.002)
        drag(page, "force-time", 0.998, 0.998)
        if all((cells := [*texts(page, "#cursors tbody tr:first-child td"), "", "", ""])[1:3]):
            break
        time.sleep(0.2)
    page.press("Escape")
    return float(cells[1]), float(cells[2])


def test_a_part_is_chosen_by_dragging_and_moved_by_wheel_and_keys(whole: Browser) -> None:
    assert first_and_last_time(whole) == pytest.approx((110.0, 120.0), abs=0.1)
    drag(whole, "force-time", 0.25, 0.75)
    whole.until(f"!{NEWEST}.hidden")
    assert first_and_last_time(whole) == pytest.approx((112.5, 117.5), abs=0.1)
    whole.press("ArrowLeft")
    assert first_and_last_time(whole) == pytest.approx((111.25, 116.25), abs=0.1)
    wheel(whole, "force-time", 100.0)
    assert first_and_last_time(whole) == pytest.approx((110.6, 116.9), abs=0.1)
    wheel(whole, "force-time", -100.0, sideways=True)
    assert first_and_last_time(whole) == pytest.approx((110.0, 116.3), abs=0.1)
    whole.press("0")
    whole.until(f"{NEWEST}.hidden")
    assert first_and_last_time(whole) == pytest.approx((110.0, 120.0), abs=0.1)


def test_the_whole_run_is_there_to_scroll_back_to(whole: Browser) -> None:
    for _ in filter(lambda _: whole.evaluate(f"{NEWEST}.hidden"), range(50)):
        drag(whole, "run", 0.0833, 0.1667)
        time.sleep(0.2)
    assert first_and_last_time(whole) == pytest.approx((10.0, 20.0), abs=0.3)
    drag(whole, "force-time", 0.5, 0.5)
    force = "document.querySelector('#cursors tbody tr:nth-child(2) td:nth-child(2)').innerText"
    assert abs(float(whole.until(force))) < 700.0
    whole.press("0")


def test_the_page_joins_rows_of_the_history_as_the_record_does(browser: Browser) -> None:
    code = (PAGE / "page.js").read_text(encoding="utf-8")
    join = code[code.index("function joinOlder") : code.index("async function fetchStatus")]
    rows = np.arange(4.0 * (1 + len(HISTORY))).reshape(4, -1)
    found = browser.evaluate(f"{join} rows = {rows.tolist()}; joinOlder(rows); [...rows[0]]")
    # The page needs the fraction of valid force of a joined row only roughly.
    assert found[:-1] == _joined_ranges(rows[np.newaxis, :2])[0, :-1].tolist()


def test_two_cursors_say_values_and_differences(whole: Browser) -> None:
    drag(whole, "force-time", 0.2, 0.2)
    drag(whole, "force-time", 0.3, 0.3)
    whole.until("document.querySelector('#cursors tr:first-child td:nth-child(4)').innerText")
    rows = whole.evaluate(
        "[...document.querySelectorAll('#cursors tbody tr')]"
        ".map(row => [...row.cells].map(cell => cell.innerText))"
    )
    assert rows[0][3] == "1 (1 Hz)" or rows[0][3].startswith(("0.99", "1.00"))
    for label, first, second, less in rows[1:]:
        assert float(less) == pytest.approx(float(second) - float(first), abs=0.06), label
    assert [row[0] for row in rows[1:3]] == ["measured force [N]", "predicted force [N]"]
    whole.press("Escape")
    whole.until("document.querySelector('#cursors').hidden")


def test_a_part_of_a_loop_is_enlarged(whole: Browser) -> None:
    before = ink_at_rest(whole, "[data-chart=force-velocity]")
    drag(whole, "force-velocity", 0.5, 0.8, down=60.0)
    now = "document.querySelector('[data-chart=force-velocity] canvas').toDataURL()"
    whole.until(f"{now} !== {before!r}")


def test_events_are_marked_and_lead_to_their_place(browser: Browser) -> None:
    record = running_damper.running(3)
    for number in range(300):
        current = 0.5 if number < 150 else 1.2
        at = running_damper.START + 3.0 + 0.01 * number
        running_damper.add_signals(record, at, 0.0, 0.0, current, 0.0, 0.0, valid=True)
    record.add_concern(Concern("supply: supply", 2, "its watchdog has tripped", {}))
    running_damper.show_set(record, 5)
    with opened(browser, record):
        browser.until("document.querySelectorAll('#mark-rows tr').length >= 4")
        told = browser.text("#mark-rows")
        assert "current: 0.5 to 1.2 A" in told
        assert "fault: supply: supply: its watchdog has tripped" in told
        assert "set accepted: nelder_mead-5 (nelder mead)" in told
        rows = "[...document.querySelectorAll('#mark-rows tr')]"
        step = f"{rows}.find(row => /1.2 A/.test(row.innerText))"
        assert browser.evaluate(f"{step}.cells[0].innerText") == "4.5 s"
        browser.evaluate(f"{step}.querySelector('button').click()")
        browser.until(f"!{NEWEST}.hidden")


def test_what_is_commanded_is_drawn_beside_what_there_is(browser: Browser) -> None:
    record = running_damper.running(3)
    record.set_point("current_command", 0.7)
    record.set_point("desired_force", 333.0)
    running_damper.show_signals(record, 3.0, 3.0)
    with opened(browser, record):
        browser.until("document.querySelector('#tile-current')?.innerText.includes('commanded')")
        for chart in ("force-time", "current-time"):
            browser.until(f"{pixels(chart, 'blue > red + 20 && red > green + 15')} > 20")


def test_loops_have_the_full_rate_and_a_reference_behind_them(browser: Browser) -> None:
    record = LiveRecord()
    running_damper.show_samples(record, 6.0)
    loop = "document.querySelector('[data-chart=force-velocity]')"
    with opened(browser, record) as address:
        browser.until(f"Number({loop}?.dataset.rate) > 900")
        browser.evaluate("document.querySelector('#reference').click()")
        browser.until("document.querySelector('#reference-key').innerText.includes('0.5 A')")
        kept = browser.evaluate("JSON.parse(localStorage.getItem('reference')).velocity[0].length")
        assert kept > 1000
        browser.open(address)
        browser.until("document.querySelector('#reference')?.innerText === 'Drop the reference'")
        browser.evaluate("document.querySelector('#reference').click()")
        assert browser.evaluate("localStorage.getItem('reference')") is None


def test_a_run_is_recorded_with_name_operator_and_note(browser: Browser) -> None:
    record, taken = running_damper.running(3), []

    def take(name: str, told: Mapping[str, str]) -> bool:
        taken.append((name, dict(told)))
        path = {"path": "/bags/one", "began": f"{time.time():.3f}"}
        record.set_recording({**told, **path} if name == "record" else None)
        return True

    commands = ("record", "stop_recording")
    with opened(browser, record, "", commands, take):
        browser.until("document.querySelector('#record')?.hidden === false")
        browser.press("r")
        browser.until("document.querySelector('#recording').open")
        for name, text in (("name", "warm"), ("operator", "Ada"), ("note", "two & three")):
            field = f"document.querySelector('#recording [name={name}]')"
            browser.evaluate(f"{field}.value = {text!r}")
        browser.evaluate("document.querySelector('#recording [value=record]').click()")
        browser.until("document.querySelector('#record').innerText.includes('Recording 0:')")
        browser.until("document.querySelector('#mark-rows').innerText.includes('recording begins')")
        browser.evaluate("document.querySelector('#record').click()")
        browser.until("document.querySelector('#record').innerText === '● Record'")
    said = {"name": "warm", "operator": "Ada", "note": "two & three"}
    assert taken == [("record", said), ("stop_recording", {})]


def test_a_recording_is_opened_on_the_page(browser: Browser) -> None:
    bag = Path(__file__).parents[2] / "bags" / "5.0mm_1Hz_1.5A"
    record = empty_record(bag)
    replay_into(record, bag)
    with opened(browser, record):
        browser.until("document.querySelector('#state')?.innerText.includes('recorded')")
        assert browser.text("#state") == f"■ recorded: {bag.name}"
        browser.until("document.querySelector('#alarms').clientHeight === 0")  # no node is missed
        browser.until("document.querySelectorAll('#window-rows tr').length > 2")
        begin, end = first_and_last_time(browser)
        assert begin < 0.2
        times = record.rows("signals", -1, -1).values[:, 1]
        assert end == pytest.approx(times[-1] - times[0], rel=0.02)
        assert grey(browser) == set()
        assert browser.errors == []


@pytest.mark.parametrize(
    ("main", "arguments", "sentence"),
    [
        (live.main, ["--bag", "none", "--port", "0"], "mr-damper live: there is no bag at none"),
        (live.main, ["--bag", "none", "--port", "65536"], "'65536' is not a port"),
        (watch.main, ["--namespace", "a b"], "'a b' is not a namespace such as /rig1"),
    ],
)
def test_an_option_that_cannot_be_is_named(
    main: Any, arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        sys.exit(main(arguments))
    assert sentence in capsys.readouterr().err


def ink_at_rest(page: Browser, chart: str) -> str:
    """Content of a figure after it has not changed for half a second."""
    deadline = time.monotonic() + PATIENCE
    before, now = "", ink(page, chart)
    while now != before:
        assert time.monotonic() < deadline, "it never stands still"
        time.sleep(0.5)
        before, now = now, ink(page, chart)
    return now


def test_it_moves_and_stands_still_while_it_is_paused(page: Browser) -> None:
    chart = '[data-chart="force-time"]'
    first = ink(page, chart)
    page.until(f"document.querySelector('{chart} canvas').toDataURL() !== {first!r}")
    page.press(" ")
    assert page.text("#state") == "❚❚ paused"
    page.until("document.querySelector('#pause').innerText === 'Continue'")
    still = ink_at_rest(page, chart)
    page.press(" ")
    page.until(f"document.querySelector('{chart} canvas').toDataURL() !== {still!r}")
    page.until("document.querySelector('#state').innerText.includes('live')")


def test_keys_choose_the_span_and_lead_to_the_sections(page: Browser) -> None:
    chosen = "document.querySelector('#spans :checked').value"
    assert page.evaluate(chosen) == "10"
    page.press("]")
    assert page.evaluate(chosen) == "50"
    for _ in range(3):
        page.press("[")
    assert page.evaluate(chosen) == "2"
    page.press("4")
    page.until("document.querySelector('nav [aria-current]').hash === '#parameters'")
    page.press("1")
    page.until("document.querySelector('nav [aria-current]').hash === '#force'")
    page.press("?")
    assert "pause" in page.text("dialog[open]")


def test_a_telephone_shows_it_without_scrolling_sideways(page: Browser) -> None:
    page.resize(390, 844, 2.0)
    page.until("document.querySelector('[data-chart=force-time] canvas').clientWidth < 390")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    why = "document.querySelector('td.why').getBoundingClientRect()"
    assert page.evaluate(f"{why}.width > 200 && {why}.right <= 390")
    for link in range(7):
        shown = f"document.querySelectorAll('nav a')[{link}].getBoundingClientRect()"
        assert page.evaluate(f"{shown}.left >= 0 && {shown}.right <= 390 && {shown}.bottom <= 844")
    drag(page, "force-time", 0.3, 0.3)
    drag(page, "force-time", 0.6, 0.6)
    page.until("!document.querySelector('#cursors').hidden")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.press("Escape")
    page.evaluate("document.querySelector('nav a[href=\"#health\"]').click()")
    page.until("document.querySelector('nav [aria-current]').hash === '#health'")
    assert page.evaluate("document.querySelector('header').getBoundingClientRect().height") < 200
    page.resize(1280, 900)


def saved(folder: Path, pattern: str) -> Path:
    """The saved file, once it exists and is not empty."""
    return until(
        lambda: next((path for path in folder.glob(pattern) if path.stat().st_size), None), pattern
    )


def test_figures_and_tables_are_saved(page: Browser, tmp_path: Path) -> None:
    page.send("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    page.press("p")
    page.press("c")
    picture = saved(tmp_path, "damper-force-*.png")
    table = saved(tmp_path, "damper-force-*.csv")
    assert picture.read_bytes().startswith(b"\x89PNG")
    lines = table.read_text(encoding="utf-8-sig").splitlines()
    head = "index,time [s],displacement [m],velocity [m/s],current [A],measured_force [N]"
    assert lines[0].startswith(head)
    assert lines[-1].endswith(",yes"), "whether the force is valid, in words"
    assert len(lines) > 100 * SECONDS
    page.press("2")
    page.until("document.querySelector('nav [aria-current]').hash === '#drift'")
    page.press("c")
    windows = saved(tmp_path, "damper-drift-*.csv")
    rows = windows.read_text(encoding="utf-8-sig").splitlines()
    assert rows[-1].endswith(",disturbed,no")


def test_it_finds_the_node_again(browser: Browser, record: LiveRecord) -> None:
    with closing(PageServer(record, "127.0.0.1", 0)) as server:
        port = urlsplit(server.address).port or 0
        browser.open(server.address)
        browser.until("document.querySelector('#state')?.innerText.includes('live')")
    browser.until("document.querySelector('#state').innerText.includes('no connection')")
    other = running_damper.running(3)
    with closing(PageServer(other, "127.0.0.1", port)):
        browser.until("document.querySelectorAll('#window-rows tr').length === 2")
        browser.until("!document.querySelector('#state').innerText.includes('no connection')")
        leave(browser)


def grey(browser: Browser) -> set[str]:
    """Captions of values that are not current."""
    expression = (
        "[...document.querySelectorAll('.gone')]"
        ".map((shown) => shown.querySelector('dt, h2, strong').innerText)"
    )
    return set(browser.evaluate(expression))


GONE = "document.querySelectorAll('.gone').length"


def test_what_is_not_heard_any_more_is_grey_and_says_since_when(browser: Browser) -> None:
    clock = 100.0
    record = LiveRecord(lambda: clock)
    running_damper.show_signals(record, 0.0, 3.0)
    running_damper.show_window(record, 2)
    running_damper.show_health(record)
    with opened(browser, record):
        browser.until("document.querySelector('#state')?.innerText === '● live'")
        browser.until(f"document.querySelector('#tile-prediction .sign')?.innerText && !{GONE}")
        clock = 112.0
        running_damper.show_signals(record, 3.0, 1.0)
        others = ("model", "supply", "bridge", "safety", "controller", "campaign")
        running_damper.show_health(record, others)
        browser.until(GONE)
        assert grey(browser) == {
            *("Force scale", "Temperature", "Motion", "Drift", "Operating-point coefficients"),
            *("Windows", "identifier: window", "identifier: state"),
        }
        assert browser.text("#state") == "✕ live; no messages from identifier"
        shown = browser.text('[data-name="identifier: window"]')
        assert re.search(r"no message since \d\d:\d\d:\d\d \(12 s\)", shown)
        assert "good" not in shown

        clock = 124.0
        running_damper.show_health(record)
        browser.until("document.querySelector('#state').innerText === '▲ no signals for 12 s'")
        assert grey(browser) == {"Force", "Error over the span", "Current"}


def test_the_alarm_bar_is_in_view_and_keeps_faults_until_they_are_seen(browser: Browser) -> None:
    record = running_damper.running(3, lambda: 100.0)
    with opened(browser, record):
        browser.until("document.querySelector('#alarms')?.innerText.includes('cannot be kept')")
        assert texts(browser, "#alarms dd")[:3] == ["✓ on, 0.503 A", "✓ 5 mm, 1.5 Hz", "✓ closed"]
        browser.press("7")
        browser.until("scrollY > innerHeight")
        top = "document.querySelector('#alarms').getBoundingClientRect()"
        assert browser.evaluate(f"{top}.top >= 0 && {top}.bottom < innerHeight / 3")
        record.add_concern(Concern("identifier: state", 0, "kept", {}))
        record.add_concern(Concern("safety: interlock", 2, "open: the door", {}))
        browser.until("document.querySelector('#faults').innerText.includes('open: the door')")
        assert texts(browser, "#alarms dd")[2] == "✕ open: the door"
        assert "and 1 more" in texts(browser, "#alarms dd")[3]
        browser.evaluate("document.querySelector('#seen').click()")
        browser.until("document.querySelector('#seen').hidden")
        assert texts(browser, "#alarms dd")[3] == "✕ 1 acknowledged, not over yet"
        record.add_concern(Concern("safety: interlock", 0, "closed", {}))
        browser.until("document.querySelector('#faults dd').innerText === '✓ none'")
