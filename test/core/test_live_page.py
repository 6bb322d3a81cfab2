"""The page in a headless Chromium: figures, texts, keys, themes, small screens."""

from __future__ import annotations

import json
import re
import shutil
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np
import pytest
import running_damper
from waiting import PATIENCE, until

from mr_damper_ros.live.live_record import HISTORY, Concern, LiveRecord, _joined_ranges
from mr_damper_ros.live.page_server import PAGE, PageServer
from mr_damper_ros.tools import live, watch
from mr_damper_ros.tools.live import empty_record, replay_into

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

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
    """The Chromium of this computer, without a window."""
    playwright = pytest.importorskip("playwright.sync_api")
    programs = map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))
    program = next(filter(None, programs), None)
    if program is None:
        pytest.skip("Chromium is not installed, and the page can be seen in no other way here")
    with playwright.sync_playwright() as driver:
        yield driver.chromium.launch(executable_path=program, args=["--disable-gpu"])


@pytest.fixture(scope="module")
def tab(browser: Browser) -> Page:
    """One tab for most tests, because each new one takes a second to compile the page."""
    return browser.new_page(viewport={"width": 1280, "height": 900})


@pytest.fixture(scope="module")
def record() -> Iterator[LiveRecord]:
    with closing(GoingOn()) as stream:
        yield stream.record


@contextmanager
def opened(page: Page, record: LiveRecord, *served: Any) -> Iterator[None]:
    """Show the page of a record; fails if it reports an error, or requests anything elsewhere."""
    page.clear_page_errors()
    page.clear_console_messages()
    with closing(PageServer(record, "127.0.0.1", 0, *served)) as server:
        page.goto(server.address)
        yield
        told = page.console_messages()
        assert page.page_errors() == []
        assert [message.text for message in told if message.type == "error"] == []
        loaded = page.evaluate("performance.getEntriesByType('resource').map(entry => entry.name)")
        assert {urlsplit(url).netloc for url in loaded} == {urlsplit(server.address).netloc}
        page.goto("about:blank")


def wait_for(page: Page, expression: str) -> Any:
    """Wait until a JavaScript expression is true, and return its value.

    ``page.wait_for_function`` does not run under the Content-Security-Policy of the page.
    """
    return until(lambda: page.evaluate(expression), expression)


@pytest.fixture
def page(tab: Page, record: LiveRecord) -> Iterator[Page]:
    """The live page."""
    with opened(tab, record, "/"):
        wait_for_the_figures(tab)
        yield tab


def wait_for_the_figures(page: Page) -> None:
    wait_for(page, "document.querySelector('#state')?.innerText.includes('live')")
    wait_for(page, "document.querySelectorAll('figure canvas').length >= 35")


def ink(page: Page, chart: str) -> str:
    """Content of a figure, as a text that changes with it."""
    return page.evaluate(f"document.querySelector('{chart} canvas').toDataURL()")


def texts(page: Page, selector: str) -> list[str]:
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


def test_figures_tiles_windows_and_diagnostics_are_shown(page: Page) -> None:
    names = page.evaluate("[...document.querySelectorAll('figure canvas')].length")
    # Twelve named values, seven coefficients, sixteen parameters.
    assert names == 12 + 7 + 16
    for chart in ("force-velocity", "force-displacement", "force-time"):
        blue = page.evaluate(pixels(chart, "blue > red + 100"))
        orange = page.evaluate(pixels(chart, "red > blue + 100"))
        assert min(blue, orange) > 50, f"{chart}: measured and predicted are drawn"
    assert page.inner_text("#tile-prediction").split() == ["✓", "valid"], (
        "one error, in its own tile"
    )
    assert page.inner_text("#tile-scale").split() == ["0.952", "±", "0.003"]
    assert re.search("(?s)^5 mm, 1.5 Hz.*commanded 5 mm, 1.5 Hz", page.inner_text("#tile-motion"))
    assert page.inner_text("#tile-supply").split("\n") == ["0.503 A", "set 0.5 A; output on"]
    assert "200 N desired" in page.inner_text("#tile-controller")
    assert "run 3" in page.inner_text("#tile-campaign")
    assert page.inner_text("#tile-current") == "0.5 A"
    assert f"nelder_mead-{SECONDS - 1}" in page.inner_text("#tile-set")
    assert page.inner_text("#tile-latency").startswith("0.612 ms")
    assert page.inner_text("#tile-lost").startswith("3")
    assert page.inner_text("#tile-error").split()[1] == "%"
    coefficient = page.inner_text('#coefficients [data-name="f_t"] figcaption')
    assert coefficient.split() == ["f_t", "590.2", "±", "12", "N"]
    assert re.search("(?s)±.*N$", page.inner_text('#parameters [data-name="f0"] figcaption'))
    assert page.inner_text('#parameters [data-name="k6"] figcaption').endswith("not determined")
    rows = texts(page, "#window-rows tr")
    assert len(rows) == SECONDS - 1
    assert "✕ disturbed" in rows[0]
    assert "a hammer blow" in rows[0]
    assert "✓ accepted" in rows[1]
    shown = page.inner_text("#concerns")
    assert "✕ error: the state cannot be kept" in shown
    assert "▲ warning: 3 samples were lost" in shown
    assert "✓ good: window 40% full" in shown


def place_of(page: Page, chart: str, across: float) -> tuple[float, float]:
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
def test_a_figure_says_the_values_under_the_pointer(page: Page, chart: str, shown: str) -> None:
    figure = f"[data-chart={chart}]"
    x, y = place_of(page, chart, 0.5)
    for at in (x - 3, x):
        page.mouse.move(at, y)
    pattern = f"new RegExp({json.dumps(f'^{shown}$')})"
    wait_for(page, f"{pattern}.test(document.querySelector('{figure} output').value)")


def test_an_outlier_does_not_flatten_a_figure(tab: Page) -> None:
    record = running_damper.running(3)
    running_damper.add_signals(
        record, running_damper.START + 3.0, 0.0, 0.0, 0.5, 1e6, 0.0, valid=True
    )
    running_damper.show_signals(record, 3.01, 1.0)
    with opened(tab, record):
        output = "document.querySelector('[data-chart=force-time] output')"
        wait_for(tab, f"{output}?.value === '1 outside the view'")


def drag(page: Page, chart: str, begin: float, end: float, down: float = 0.0) -> None:
    """Drag from one point of a figure to another; click if the two are equal."""
    first, last = place_of(page, chart, begin), place_of(page, chart, end)
    page.mouse.move(*first)
    page.mouse.down()
    if begin != end:
        page.mouse.move(0.5 * (first[0] + last[0]), last[1])
    page.mouse.move(last[0], last[1] + down)
    page.mouse.up()


def wheel(page: Page, chart: str, across: float, down: float) -> None:
    page.mouse.move(*place_of(page, chart, 0.5))
    page.mouse.wheel(across, down)


NEWEST = "document.querySelector('[data-do=newest]')"
RUN = running_damper.running(120)
"""Two minutes; the page has only the signals of the last one."""


@pytest.fixture
def whole(tab: Page) -> Iterator[Page]:
    """The page of a run that does not advance."""
    with opened(tab, RUN):
        wait_for(tab, "document.querySelectorAll('[data-chart=run] canvas').length")
        wait_for(tab, "document.querySelectorAll('[data-chart=force-time] canvas').length")
        yield tab


def first_and_last_time(page: Page) -> tuple[float, float]:
    """Time range of the figures, read from the cursors at both edges."""
    wait_for(page, "document.querySelectorAll('[data-chart=force-time] .u-over').length")
    for _ in range(50):  # a message above the figures may move them between the clicks
        page.keyboard.press("Escape")
        drag(page, "force-time", 0.002, 0.002)
        drag(page, "force-time", 0.998, 0.998)
        if all((cells := [*texts(page, "#cursors tbody tr:first-child td"), "", "", ""])[1:3]):
            break
        time.sleep(0.2)
    page.keyboard.press("Escape")
    return float(cells[1]), float(cells[2])


def test_a_part_is_chosen_by_dragging_and_moved_by_wheel_and_keys(whole: Page) -> None:
    assert first_and_last_time(whole) == pytest.approx((110.0, 120.0), abs=0.1)
    drag(whole, "force-time", 0.25, 0.75)
    wait_for(whole, f"!{NEWEST}.hidden")
    assert first_and_last_time(whole) == pytest.approx((112.5, 117.5), abs=0.1)
    whole.keyboard.press("ArrowLeft")
    assert first_and_last_time(whole) == pytest.approx((111.25, 116.25), abs=0.1)
    wheel(whole, "force-time", 0.0, 100.0)
    assert first_and_last_time(whole) == pytest.approx((110.6, 116.9), abs=0.1)
    wheel(whole, "force-time", -100.0, 0.0)
    assert first_and_last_time(whole) == pytest.approx((110.0, 116.3), abs=0.1)
    whole.keyboard.press("0")
    wait_for(whole, f"{NEWEST}.hidden")
    assert first_and_last_time(whole) == pytest.approx((110.0, 120.0), abs=0.1)


def test_the_whole_run_is_there_to_scroll_back_to(whole: Page) -> None:
    for _ in filter(lambda _: whole.evaluate(f"{NEWEST}.hidden"), range(50)):
        drag(whole, "run", 0.0833, 0.1667)
        time.sleep(0.2)
    assert first_and_last_time(whole) == pytest.approx((10.0, 20.0), abs=0.3)
    drag(whole, "force-time", 0.5, 0.5)
    force = "document.querySelector('#cursors tbody tr:nth-child(2) td:nth-child(2)').innerText"
    assert abs(float(wait_for(whole, force))) < 700.0
    whole.keyboard.press("0")


def test_the_page_joins_rows_of_the_history_as_the_record_does(tab: Page) -> None:
    code = (PAGE / "page.js").read_text(encoding="utf-8")
    join = code[code.index("function joinOlder") : code.index("async function fetchStatus")]
    rows = np.arange(4.0 * (1 + len(HISTORY))).reshape(4, -1)
    found = tab.evaluate(
        f"rows => {{ {join} joinOlder(rows); return [...rows[0]]; }}", rows.tolist()
    )
    # The page needs the fraction of valid force of a joined row only roughly.
    assert found[:-1] == _joined_ranges(rows[np.newaxis, :2])[0, :-1].tolist()


def test_two_cursors_say_values_and_differences(whole: Page) -> None:
    drag(whole, "force-time", 0.2, 0.2)
    drag(whole, "force-time", 0.3, 0.3)
    wait_for(whole, "document.querySelector('#cursors tr:first-child td:nth-child(4)').innerText")
    rows = whole.evaluate(
        "[...document.querySelectorAll('#cursors tbody tr')]"
        ".map(row => [...row.cells].map(cell => cell.innerText))"
    )
    assert rows[0][3] == "1 (1 Hz)" or rows[0][3].startswith(("0.99", "1.00"))
    for label, first, second, less in rows[1:]:
        assert float(less) == pytest.approx(float(second) - float(first), abs=0.06), label
    assert [row[0] for row in rows[1:3]] == ["measured force [N]", "predicted force [N]"]
    whole.keyboard.press("Escape")
    wait_for(whole, "document.querySelector('#cursors').hidden")


def test_a_part_of_a_loop_is_enlarged(whole: Page) -> None:
    before = ink_at_rest(whole, "[data-chart=force-velocity]")
    drag(whole, "force-velocity", 0.5, 0.8, down=60.0)
    now = "document.querySelector('[data-chart=force-velocity] canvas').toDataURL()"
    wait_for(whole, f"{now} !== {before!r}")


def test_events_are_marked_and_lead_to_their_place(tab: Page) -> None:
    record = running_damper.running(3)
    for number in range(300):
        current = 0.5 if number < 150 else 1.2
        at = running_damper.START + 3.0 + 0.01 * number
        running_damper.add_signals(record, at, 0.0, 0.0, current, 0.0, 0.0, valid=True)
    record.add_concern(Concern("supply: supply", 2, "its watchdog has tripped", {}))
    running_damper.show_set(record, 5)
    with opened(tab, record):
        wait_for(tab, "document.querySelectorAll('#mark-rows tr').length >= 4")
        told = tab.inner_text("#mark-rows")
        assert "current: 0.5 to 1.2 A" in told
        assert "fault: supply: supply: its watchdog has tripped" in told
        assert "set accepted: nelder_mead-5 (nelder mead)" in told
        rows = "[...document.querySelectorAll('#mark-rows tr')]"
        step = f"{rows}.find(row => /1.2 A/.test(row.innerText))"
        assert tab.evaluate(f"{step}.cells[0].innerText") == "4.5 s"
        tab.evaluate(f"{step}.querySelector('button').click()")
        wait_for(tab, f"!{NEWEST}.hidden")


def test_what_is_commanded_is_drawn_beside_what_there_is(tab: Page) -> None:
    record = running_damper.running(3)
    record.set_point("current_command", 0.7)
    record.set_point("desired_force", 333.0)
    running_damper.show_signals(record, 3.0, 3.0)
    with opened(tab, record):
        wait_for(tab, "document.querySelector('#tile-current')?.innerText.includes('commanded')")
        for chart in ("force-time", "current-time"):
            wait_for(tab, f"{pixels(chart, 'blue > red + 20 && red > green + 15')} > 20")


def test_loops_have_the_full_rate_and_a_reference_behind_them(tab: Page) -> None:
    record = LiveRecord()
    running_damper.show_samples(record, 6.0)
    loop = "document.querySelector('[data-chart=force-velocity]')"
    with opened(tab, record):
        wait_for(tab, f"Number({loop}?.dataset.rate) > 900")
        tab.evaluate("document.querySelector('#reference').click()")
        wait_for(tab, "document.querySelector('#reference-key').innerText.includes('0.5 A')")
        kept = tab.evaluate("JSON.parse(localStorage.getItem('reference')).velocity[0].length")
        assert kept > 1000
        tab.reload()
        wait_for(tab, "document.querySelector('#reference')?.innerText === 'Drop the reference'")
        tab.evaluate("document.querySelector('#reference').click()")
        assert tab.evaluate("localStorage.getItem('reference')") is None


def test_a_run_is_recorded_with_name_operator_and_note(tab: Page) -> None:
    record, taken = running_damper.running(3), []

    def take(name: str, told: Mapping[str, str]) -> bool:
        taken.append((name, dict(told)))
        path = {"path": "/bags/one", "began": f"{time.time():.3f}"}
        record.set_recording({**told, **path} if name == "record" else None)
        return True

    commands = ("record", "stop_recording")
    with opened(tab, record, "", commands, take):
        wait_for(tab, "document.querySelector('#record')?.hidden === false")
        tab.keyboard.press("r")
        wait_for(tab, "document.querySelector('#recording').open")
        for name, text in (("name", "warm"), ("operator", "Ada"), ("note", "two & three")):
            field = f"document.querySelector('#recording [name={name}]')"
            tab.evaluate(f"{field}.value = {text!r}")
        tab.evaluate("document.querySelector('#recording [value=record]').click()")
        wait_for(tab, "document.querySelector('#record').innerText.includes('Recording 0:')")
        wait_for(tab, "document.querySelector('#mark-rows').innerText.includes('recording begins')")
        tab.evaluate("document.querySelector('#record').click()")
        wait_for(tab, "document.querySelector('#record').innerText === '● Record'")
    said = {"name": "warm", "operator": "Ada", "note": "two & three"}
    assert taken == [("record", said), ("stop_recording", {})]


def test_a_recording_is_opened_on_the_page(tab: Page) -> None:
    bag = Path(__file__).parents[2] / "bags" / "5.0mm_1Hz_1.5A"
    record = empty_record(bag)
    replay_into(record, bag)
    with opened(tab, record):
        wait_for(tab, "document.querySelector('#state')?.innerText.includes('recorded')")
        assert tab.inner_text("#state") == f"■ recorded: {bag.name}"
        wait_for(tab, "document.querySelector('#alarms').clientHeight === 0")  # no node is missed
        wait_for(tab, "document.querySelectorAll('#window-rows tr').length > 2")
        begin, end = first_and_last_time(tab)
        assert begin < 0.2
        times = record.rows("signals", -1, -1).values[:, 1]
        assert end == pytest.approx(times[-1] - times[0], rel=0.02)
        assert grey(tab) == set()


@pytest.mark.parametrize(
    ("main", "arguments", "sentence"),
    [
        (live.main, ["--bag", "none", "--port", "0"], "mr-damper live: there is no bag at none"),
        (live.main, ["--bag", "none", "--port", "65536"], "'65536' is not a port"),
        (live.main, ["--bag", "none", "--namespace", "/a"], "--namespace is for a running system"),
        (watch.main, ["--namespace", "a b"], "'a b' is not a namespace such as /rig1"),
    ],
)
def test_an_option_that_cannot_be_is_named(
    main: Any, arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        sys.exit(main(arguments))
    assert sentence in capsys.readouterr().err


def ink_at_rest(page: Page, chart: str) -> str:
    """Content of a figure after it has not changed for half a second."""
    deadline = time.monotonic() + PATIENCE
    before, now = "", ink(page, chart)
    while now != before:
        assert time.monotonic() < deadline, "it never stands still"
        time.sleep(0.5)
        before, now = now, ink(page, chart)
    return now


def test_it_moves_and_stands_still_while_it_is_paused(page: Page) -> None:
    chart = '[data-chart="force-time"]'
    first = ink(page, chart)
    wait_for(page, f"document.querySelector('{chart} canvas').toDataURL() !== {first!r}")
    page.keyboard.press("Space")
    assert page.inner_text("#state") == "❚❚ paused"
    wait_for(page, "document.querySelector('#pause').innerText === 'Continue'")
    still = ink_at_rest(page, chart)
    page.keyboard.press("Space")
    wait_for(page, f"document.querySelector('{chart} canvas').toDataURL() !== {still!r}")
    wait_for(page, "document.querySelector('#state').innerText.includes('live')")


def test_keys_choose_the_span_and_lead_to_the_sections(page: Page) -> None:
    chosen = "document.querySelector('#spans :checked').value"
    assert page.evaluate(chosen) == "10"
    page.keyboard.press("]")
    assert page.evaluate(chosen) == "50"
    for _ in range(3):
        page.keyboard.press("[")
    assert page.evaluate(chosen) == "2"
    page.keyboard.press("4")
    wait_for(page, "document.querySelector('nav [aria-current]').hash === '#parameters'")
    page.keyboard.press("1")
    wait_for(page, "document.querySelector('nav [aria-current]').hash === '#force'")
    page.keyboard.press("?")
    assert "pause" in page.inner_text("dialog[open]")


@pytest.fixture
def telephone(browser: Browser, record: LiveRecord) -> Iterator[Page]:
    screen = {"viewport": {"width": 390, "height": 844}, "device_scale_factor": 2.0}
    with browser.new_page(**screen, is_mobile=True) as page, opened(page, record, "/"):
        wait_for_the_figures(page)
        yield page


def test_a_telephone_shows_it_without_scrolling_sideways(telephone: Page) -> None:
    page = telephone
    wait_for(page, "document.querySelector('[data-chart=force-time] canvas').clientWidth < 390")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    why = "document.querySelector('td.why').getBoundingClientRect()"
    assert page.evaluate(f"{why}.width > 200 && {why}.right <= 390")
    for link in range(7):
        shown = f"document.querySelectorAll('nav a')[{link}].getBoundingClientRect()"
        assert page.evaluate(f"{shown}.left >= 0 && {shown}.right <= 390 && {shown}.bottom <= 844")
    drag(page, "force-time", 0.3, 0.3)
    drag(page, "force-time", 0.6, 0.6)
    wait_for(page, "!document.querySelector('#cursors').hidden")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.keyboard.press("Escape")
    page.evaluate("document.querySelector('nav a[href=\"#health\"]').click()")
    wait_for(page, "document.querySelector('nav [aria-current]').hash === '#health'")
    assert page.evaluate("document.querySelector('header').getBoundingClientRect().height") < 200


def saved(page: Page, key: str) -> Path:
    """The file that the page saves after a key."""
    with page.expect_download() as download:
        page.keyboard.press(key)
    return Path(download.value.path())


def test_figures_and_tables_are_saved(page: Page) -> None:
    assert saved(page, "p").read_bytes().startswith(b"\x89PNG")
    table = saved(page, "c")
    lines = table.read_text(encoding="utf-8-sig").splitlines()
    head = "index,time [s],displacement [m],velocity [m/s],current [A],measured_force [N]"
    assert lines[0].startswith(head)
    assert lines[-1].endswith(",yes"), "whether the force is valid, in words"
    assert len(lines) > 100 * SECONDS
    page.keyboard.press("2")
    wait_for(page, "document.querySelector('nav [aria-current]').hash === '#drift'")
    rows = saved(page, "c").read_text(encoding="utf-8-sig").splitlines()
    assert rows[-1].endswith(",disturbed,no")


def test_it_finds_the_node_again(tab: Page, record: LiveRecord) -> None:
    with closing(PageServer(record, "127.0.0.1", 0)) as server:
        port = urlsplit(server.address).port or 0
        tab.goto(server.address)
        wait_for(tab, "document.querySelector('#state')?.innerText.includes('live')")
    wait_for(tab, "document.querySelector('#state').innerText.includes('no connection')")
    with closing(PageServer(running_damper.running(3), "127.0.0.1", port)):
        wait_for(tab, "document.querySelectorAll('#window-rows tr').length === 2")
        wait_for(tab, "!document.querySelector('#state').innerText.includes('no connection')")
        tab.goto("about:blank")


def grey(page: Page) -> set[str]:
    """Captions of values that are not current."""
    expression = (
        "[...document.querySelectorAll('.gone')]"
        ".map((shown) => shown.querySelector('dt, h2, strong').innerText)"
    )
    return set(page.evaluate(expression))


GONE = "document.querySelectorAll('.gone').length"


def test_what_is_not_heard_any_more_is_grey_and_says_since_when(tab: Page) -> None:
    clock = 100.0
    record = LiveRecord(lambda: clock)
    running_damper.show_signals(record, 0.0, 3.0)
    running_damper.show_window(record, 2)
    running_damper.show_health(record)
    with opened(tab, record):
        wait_for(tab, "document.querySelector('#state')?.innerText === '● live'")
        wait_for(tab, f"document.querySelector('#tile-prediction .sign')?.innerText && !{GONE}")
        clock = 112.0
        running_damper.show_signals(record, 3.0, 1.0)
        others = ("model", "supply", "bridge", "safety", "controller", "campaign")
        running_damper.show_health(record, others)
        wait_for(tab, GONE)
        assert grey(tab) == {
            *("Force scale", "Temperature", "Motion", "Drift", "Operating-point coefficients"),
            *("Windows", "identifier: window", "identifier: state"),
        }
        assert tab.inner_text("#state") == "✕ live; no messages from identifier"
        shown = tab.inner_text('[data-name="identifier: window"]')
        assert re.search(r"no message since \d\d:\d\d:\d\d \(12 s\)", shown)
        assert "good" not in shown

        clock = 124.0
        running_damper.show_health(record)
        wait_for(tab, "document.querySelector('#state').innerText === '▲ no signals for 12 s'")
        assert grey(tab) == {"Force", "Error over the span", "Current"}


def test_the_alarm_bar_is_in_view_and_keeps_faults_until_they_are_seen(tab: Page) -> None:
    record = running_damper.running(3, lambda: 100.0)
    with opened(tab, record):
        wait_for(tab, "document.querySelector('#alarms')?.innerText.includes('cannot be kept')")
        assert texts(tab, "#alarms dd")[:3] == ["✓ on, 0.503 A", "✓ 5 mm, 1.5 Hz", "✓ closed"]
        tab.keyboard.press("7")
        wait_for(tab, "scrollY > innerHeight")
        top = "document.querySelector('#alarms').getBoundingClientRect()"
        assert tab.evaluate(f"{top}.top >= 0 && {top}.bottom < innerHeight / 3")
        record.add_concern(Concern("identifier: state", 0, "kept", {}))
        record.add_concern(Concern("safety: interlock", 2, "open: the door", {}))
        wait_for(tab, "document.querySelector('#faults').innerText.includes('open: the door')")
        assert texts(tab, "#alarms dd")[2] == "✕ open: the door"
        assert "and 1 more" in texts(tab, "#alarms dd")[3]
        tab.evaluate("document.querySelector('#seen').click()")
        wait_for(tab, "document.querySelector('#seen').hidden")
        assert texts(tab, "#alarms dd")[3] == "✕ 1 acknowledged, not over yet"
        record.add_concern(Concern("safety: interlock", 0, "closed", {}))
        wait_for(tab, "document.querySelector('#faults dd').innerText === '✓ none'")
