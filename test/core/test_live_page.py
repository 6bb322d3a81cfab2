"""What the page shows, in a headless Chromium: figures, words, keys, themes, a telephone."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import running_damper
from browser import PATIENCE, Browser

from mr_damper_ros.live.live_record import Concern, LiveRecord
from mr_damper_ros.live.page_server import PageServer

SECONDS = 12


class GoingOn:
    """A record that goes on: ten times a second a tenth of a second of signals, and diagnostics."""

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
    """Go where nothing is asked for any more."""
    browser.open("about:blank")
    browser.until("location.href === 'about:blank'")


@pytest.fixture
def page(browser: Browser, record: LiveRecord) -> Iterator[Browser]:
    """The page, open and live; on it no error has been seen at the end."""
    with closing(PageServer(record, "127.0.0.1", 0, "/")) as server:
        browser.errors.clear()
        browser.requested.clear()
        browser.resize(1280, 900)
        browser.prefer("light")
        browser.open(server.address)
        browser.until("document.querySelector('#state')?.innerText.includes('live')")
        browser.until("document.querySelectorAll('figure canvas').length >= 34")
        yield browser
        assert browser.errors == []
        host = urlsplit(server.address).netloc
        assert {urlsplit(url).netloc for url in browser.requested} == {host}
        leave(browser)


def ink(page: Browser, chart: str) -> str:
    """What a figure shows, as a text that changes with it."""
    shown: str = page.evaluate(f"document.querySelector('{chart} canvas').toDataURL()")
    return shown


def test_figures_tiles_windows_and_diagnostics_are_shown(page: Browser) -> None:
    names = page.evaluate("[...document.querySelectorAll('figure canvas')].length")
    # Eleven by name, seven coefficients, sixteen parameters.
    assert names == 11 + 7 + 16
    for chart in ("force-velocity", "force-displacement", "force-time"):
        colours = page.evaluate(
            f"""(() => {{
              const canvas = document.querySelector('[data-chart="{chart}"] canvas');
              const bits = canvas.getContext('2d')
                .getImageData(0, 0, canvas.width, canvas.height).data;
              let blue = 0, orange = 0;
              for (let k = 0; k < bits.length; k += 4) {{
                if (bits[k + 3] && bits[k + 2] > bits[k] + 100) blue += 1;
                if (bits[k + 3] && bits[k] > bits[k + 2] + 100) orange += 1;
              }}
              return [blue, orange];
            }})()"""
        )
        assert min(colours) > 50, f"{chart}: measured and predicted are drawn"
    assert page.text("#tile-prediction").split() == ["✓", "valid"], "one error, in its own tile"
    assert page.text("#tile-scale").split() == ["0.952", "±", "0.003"]
    assert "5 mm, 1.5 Hz" in page.text("#tile-motion")
    assert page.text("#tile-current") == "0.5 A"
    assert f"nelder_mead-{SECONDS - 1}" in page.text("#tile-set")
    assert page.text("#tile-latency").startswith("0.612 ms")
    assert page.text("#tile-lost").startswith("3")
    assert page.text("#tile-error").split()[1] == "%"
    assert page.text('#coefficients [data-name="f_t"] figcaption').split() == [
        *("f_t", "590.2", "±", "12", "N")
    ]
    determined = page.text('#parameters [data-name="f0"] figcaption')
    assert "±" in determined
    assert determined.endswith("N")
    assert page.text('#parameters [data-name="k6"] figcaption').endswith("not determined")
    rows = page.evaluate("[...document.querySelectorAll('#window-rows tr')].map(r => r.innerText)")
    assert len(rows) == SECONDS - 1
    assert "✕ disturbed" in rows[0]
    assert "a hammer blow" in rows[0]
    assert "✓ accepted" in rows[1]
    shown = page.text("#concerns")
    assert "✕ error: the state cannot be kept" in shown
    assert "▲ warning: 3 samples were lost" in shown
    assert "✓ good: window 40% full" in shown


def ink_at_rest(page: Browser, chart: str) -> str:
    """What is drawn once that is the same as half a second ago; some of it may be under way."""
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
    page.until("document.querySelector('#pause').innerText === 'Go on'")
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
    page.resize(1280, 900)


def by_suffix(folder: Path) -> dict[str, Path]:
    """The files of a folder that hold something, each under its suffix."""
    files = [path for path in folder.glob("damper-force-*") if path.stat().st_size]
    return {path.suffix: path for path in files}


def test_figures_and_tables_are_saved(page: Browser, tmp_path: Path) -> None:
    page.send("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    page.press("p")
    page.press("c")
    saved = (".png", ".csv")  # while it is still coming, a download has another suffix
    deadline = time.monotonic() + PATIENCE
    while not all(suffix in (found := by_suffix(tmp_path)) for suffix in saved):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert found[".png"].read_bytes().startswith(b"\x89PNG")
    lines = found[".csv"].read_text(encoding="utf-8-sig").splitlines()
    assert lines[0].startswith(
        "index,time [s],displacement [m],velocity [m/s],current [A],measured_force [N]"
    )
    assert lines[-1].endswith(",yes"), "whether the force is valid, in words"
    assert len(lines) > 100 * SECONDS
    for path in found.values():
        path.unlink()
    page.press("2")
    page.until("document.querySelector('nav [aria-current]').hash === '#drift'")
    page.press("c")
    while not (windows := list(tmp_path.glob("damper-drift-*.csv"))):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    rows = windows[0].read_text(encoding="utf-8-sig").splitlines()
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
    """Captions of what is not shown as the present state."""
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
    with closing(PageServer(record, "127.0.0.1", 0)) as server:
        browser.open(server.address)
        browser.until("document.querySelector('#state')?.innerText === '● live'")
        browser.until(f"document.querySelector('#tile-prediction .sign').innerText && !{GONE}")
        clock = 112.0
        running_damper.show_signals(record, 3.0, 1.0)
        running_damper.show_health(record, ("model", "supply", "bridge", "safety"))
        browser.until(GONE)
        assert grey(browser) == {
            *("Force scale", "Temperature", "Motion", "Drift", "Operating-point coefficients"),
            *("Windows", "identifier: window", "identifier: state"),
        }
        assert browser.text("#state") == "✕ live; not heard: identifier"
        shown = browser.text('[data-name="identifier: window"]')
        assert re.search(r"not heard since \d\d:\d\d:\d\d \(12 s\)", shown)
        assert "good" not in shown

        clock = 124.0
        running_damper.show_health(record)
        browser.until("document.querySelector('#state').innerText === '▲ no signals for 12 s'")
        assert grey(browser) == {"Force", "Error over the span", "Current"}
        leave(browser)


def bar(browser: Browser) -> list[str]:
    """What the alarm bar says."""
    shown: list[str] = browser.evaluate(
        "[...document.querySelectorAll('#alarms dd')].map(shown => shown.innerText)"
    )
    return shown


def test_the_alarm_bar_is_in_view_and_keeps_faults_until_they_are_seen(browser: Browser) -> None:
    record = running_damper.running(3, lambda: 100.0)
    with closing(PageServer(record, "127.0.0.1", 0)) as server:
        browser.open(server.address)
        browser.until("document.querySelector('#alarms')?.innerText.includes('cannot be kept')")
        assert bar(browser)[:3] == ["✓ on, 0.503 A", "✓ 5 mm, 1.5 Hz", "✓ closed"]
        browser.press("6")
        browser.until("scrollY > innerHeight")
        top = "document.querySelector('#alarms').getBoundingClientRect()"
        assert browser.evaluate(f"{top}.top >= 0 && {top}.bottom < innerHeight / 3")
        record.add_concern(Concern("identifier: state", 0, "kept", {}))
        record.add_concern(Concern("safety: interlock", 2, "open: the door", {}))
        browser.until("document.querySelector('#faults').innerText.includes('open: the door')")
        assert bar(browser)[2] == "✕ open: the door"
        assert "and 1 more" in bar(browser)[3]
        browser.evaluate("document.querySelector('#seen').click()")
        browser.until("document.querySelector('#seen').hidden")
        assert bar(browser)[3] == "✕ 1 acknowledged, not over yet"
        record.add_concern(Concern("safety: interlock", 0, "closed", {}))
        browser.until("document.querySelector('#faults dd').innerText === '✓ none'")
        leave(browser)
