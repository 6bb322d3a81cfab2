"""Errors in the thesis' tables and figures, found by criteria that use the tables only.

A row of tables 17-40 is in error if

* its sixteen values equal those of a different current, and its force differs much from the forces
  of its own current elsewhere (copied);
* its loop would drive the machine instead of damping it (not dissipative);
* its loop has the wrong sense of rotation (hysteresis reversed);
* its force lies outside the range of its current (out of family);
* the loop of the other method differs much from it, and its offset is the less plausible of the two
  (offset).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np

from mr_damper_ros.models import published
from mr_damper_ros.models.published import (
    CONDITIONS,
    PUBLISHED_METHODS,
    Condition,
    find,
    parameters,
)
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES, operating_point_coefficients
from mr_damper_ros.report.document import Chapter, Picture, Table, chart
from mr_damper_ros.signals.arrays import Array
from studies.drawing import chapter, line
from studies.program import Campaign
from studies.thesis import facts
from studies.thesis.runs import ACROSS, draw_loop, loop, title, top_speed

Row = tuple[Condition, str]

_FAMILY = 2.0
"""Half spans of the force of one current lie within this factor of their median."""

_AGREE = 0.2
"""Largest relative norm of the difference between agreeing loops of the two methods."""

METHOD_TITLES = {"nelder_mead": "Nelder–Mead", "differential_evolution": "DE"}


class Features(NamedTuple):
    """Features of the loop of a row.

    ``half_span`` and ``offset`` are those of the force [N]. ``dissipation`` is the mean power over
    peak velocity and RMS force [1]. ``hysteresis`` is the hysteresis velocity over the peak
    velocity [1], negative if the force lags. ``stiffness`` is the component of the force in phase
    with the displacement [N], positive if the loop has the usual sense of rotation.
    """

    half_span: float
    offset: float
    dissipation: float
    hysteresis: float
    stiffness: float


def features(values: Array, condition: Condition) -> Features:
    """Features of a parameter set (16,) in a condition."""
    turn, fastest = loop(values, condition), top_speed(condition)
    coefficients = operating_point_coefficients(values, fastest, condition.current)
    force, inner = turn.force, slice(0, -1)
    return Features(
        half_span=float(0.5 * np.ptp(force)),
        offset=float(np.mean(force[inner])),
        dissipation=float(
            np.mean((force * turn.velocity)[inner])
            / (fastest * np.sqrt(np.mean(force[inner] ** 2)))
        ),
        hysteresis=float(coefficients.v_h[0] / fastest),
        stiffness=float(2.0 * np.mean((force * turn.displacement)[inner]) / condition.amplitude),
    )


def disagreement(condition: Condition) -> float:
    """Norm of the difference between the loops of the two methods, over that of the first [1]."""
    one, two = (
        loop(parameters(condition, method), condition).force for method in PUBLISHED_METHODS
    )
    return float(np.linalg.norm(two - one) / np.linalg.norm(one))


@cache
def find_errata() -> dict[Row, list[str]]:
    """Rows in error, each with the criteria that it fails."""
    rows: list[Row] = list(product(CONDITIONS, PUBLISHED_METHODS))
    seen = {row: features(parameters(*row), row[0]) for row in rows}
    spans = {
        current: float(np.median([seen[r].half_span for r in rows if r[0].current == current]))
        for current in {condition.current for condition in CONDITIONS}
    }
    distance = {row: abs(np.log(seen[row].half_span / spans[row[0].current])) for row in rows}
    found: dict[Row, list[str]] = {row: [] for row in rows}
    for row, reasons in found.items():
        one = seen[row]
        for twin in rows:
            if (
                twin[1] == row[1]
                and twin[0].current != row[0].current
                and np.array_equal(parameters(*twin), parameters(*row))
                and distance[row] > distance[twin]
            ):
                reasons.append(f"copied from {title(twin[0].name)}")
        if one.dissipation < 0.0:
            reasons.append("not dissipative")
        if one.dissipation * one.stiffness < 0.0:
            reasons.append("hysteresis reversed")
        if distance[row] > np.log(_FAMILY):
            reasons.append("out of family")
    shift = {row: one.offset / one.half_span for row, one in seen.items()}
    for condition in CONDITIONS:
        pair = [(condition, method) for method in PUBLISHED_METHODS]
        if disagreement(condition) > _AGREE and not any(found[row] for row in pair):
            usual = np.median(
                [
                    shift[row]
                    for row in rows
                    if row[0].amplitude == condition.amplitude
                    and row[0].current > 0.0
                    and not found[row]
                    and row not in pair
                ]
            )
            found[max(pair, key=lambda r: abs(shift[r] - usual))].append("offset")
    return {row: reasons for row, reasons in found.items() if reasons}


def sound_conditions() -> tuple[Condition, ...]:
    """Conditions whose Nelder-Mead row passed all criteria."""
    wrong = {condition for condition, method in find_errata() if method == "nelder_mead"}
    return tuple(c for c in CONDITIONS if c not in wrong)


class Statement(NamedTuple):
    """A statement of the thesis that its own numbers contradict."""

    statement: str
    stated: float | str
    found: float
    verdict: str


def statements() -> list[Statement]:
    """Statements of the text that its own numbers contradict."""
    low, high = facts.SEARCH_LOW, facts.SEARCH_HIGH
    most = 1.2 * np.square(high - low) / 12.0
    variances = facts.REPEATED["variance"]
    crowded = [PARAMETER_NAMES[place] for place in np.flatnonzero(variances > most)]
    cold = find("5.0mm_1Hz_0.0A")
    needed = float(np.max(np.abs(loop(parameters(cold), cold).force)))
    strokes = [_half_span(name) for name in ("5.0mm_1Hz_0.5A", "7.5mm_1Hz_0.5A")]
    rates = [_half_span(f"5.0mm_{rate}Hz_0.5A") for rate in (1, 5)]
    heated = np.abs(published.THESIS_71_CELSIUS - published.THESIS_28_CELSIUS)
    wrong = int(np.argmax(np.abs(heated - facts.HEATED)))
    a0 = PARAMETER_NAMES.index("a0")
    return [
        Statement(
            "the velocity rises by 0.06 m/s per 1 Hz (4.3)",
            facts.VELOCITY_PER_HERTZ,
            2.0 * np.pi * 5e-3,
            "for 5 mm it is 2π·5 mm per hertz; 0.06 is the rise per 2 Hz, the step between the "
            "tests",
        ),
        Statement(
            "variance of the force error [N²] beside σ = 5.526 N (Fig. 38)",
            facts.FORCE_ERROR["variance"],
            facts.FORCE_ERROR["sigma"] ** 2,
            "two different samples: the variance is not σ², nor the mean μ",
        ),
        Statement(
            "tables 10 and 11 hold runs at 0 A: largest |force| [N] within their extremes",
            needed,
            _largest_force(top_speed(cold)),
            "at 0 A no set within these extremes reaches the force of this run; the runs are those "
            "of 1.5 A (section on repeated DE)",
        ),
        Statement(
            "parameters whose variance exceeds that of a uniform distribution over the range "
            "(tables 10, 11)",
            *(0, len(crowded)),
            f"{', '.join(crowded)}: most results lie on the bounds of the search",
        ),
        Statement(
            "a0 has outliers in the box plot (4.6, Fig. 40), with the variance of table 10",
            float(variances[a0]),
            # An outlier needs a short box: half of the values lie close together, with a quarter on
            # each side. The variance is largest if the other quarter lies at the other bound.
            0.75 * 0.25 * float(high[a0] - low[a0]) ** 2,
            "found: the largest variance within the bounds that permits an outlier, 1.5 boxes "
            "beyond the box; the stated variance is larger",
        ),
        Statement(
            f"difference of {PARAMETER_NAMES[wrong]} between 28 and 71 °C (table 8)",
            *(float(facts.HEATED[wrong]), float(heated[wrong])),
            "the two values in the same table give another difference",
        ),
        Statement(
            "the force varies minimally with the frequency (4.3): half span at 5 Hz over 1 Hz (5 "
            "mm, 0.5 A)",
            *(1.0, rates[1] / rates[0]),
            "rises by a fifth; the same section also says that the force increases",
        ),
        Statement(
            "the force increases as the displacement rises (summary of chapter 4): half span at "
            "7.5 mm over 5 mm (1 Hz, 0.5 A)",
            *("> 1", strokes[1] / strokes[0]),
            "falls, as section 4.4 also says",
        ),
        Statement(
            "conditions: table 12 lists 31 runs",
            *(31, len(CONDITIONS)),
            "tables 17–40 hold 34 (7.5 mm 5 Hz at 0, 0.5, 1.0 A is missing in table 12)",
        ),
    ]


def _half_span(name: str) -> float:
    return features(parameters(find(name)), find(name)).half_span


def _largest_force(fastest: float) -> float:
    """Bound on |force| [N] at 0 A within the extremes of tables 10 and 11."""
    high = dict(zip(PARAMETER_NAMES, facts.SEARCH_HIGH, strict=True))
    low = dict(zip(PARAMETER_NAMES, facts.SEARCH_LOW, strict=True))
    yield_force = high["f0"] * (1.0 + np.exp(high["a1"] * fastest))
    offset = max(facts.REPEATED["maximum"][14], -facts.REPEATED["minimum"][14])
    slope = max(high["k1c"], high["k1e"]) * np.exp(-low["a4"] * fastest)
    return float(yield_force * (1.0 + offset) * (1.0 + slope * fastest))


def errata_part(campaign: Campaign) -> Iterator[Chapter]:
    """The chapter on errata."""
    found, rows, contradicted = find_errata(), [], statements()
    for row in product(CONDITIONS, PUBLISHED_METHODS):
        if row in found or row in facts.ROW_ERRATA:
            one = features(parameters(*row), row[0])
            rows.append(
                (
                    *(title(row[0].name), METHOD_TITLES[row[1]]),
                    ", ".join(found.get(row, ())) or "none: the row is sound",
                    *(one.half_span, one.offset, one.hysteresis),
                    100.0 * disagreement(row[0]),
                )
            )
    yield chapter(
        "errata",
        "Errata",
        f"{len(found)} of {len(CONDITIONS) * len(PUBLISHED_METHODS)} rows are in error, and "
        f"{len(contradicted)} statements contradict numbers in the thesis.",
        "Each row of tables 17–40 was checked by five criteria: copied from another current; not "
        "dissipative; hysteresis reversed; force outside the range of its current (a factor of "
        "two); implausible offset where the loops of both methods disagree. The criteria use the "
        "loop, because several parameters may change their signs together without a change of the "
        "loop. In this report, a condition is called sound if its Nelder–Mead row is sound: "
        f"{len(sound_conditions())} of {len(CONDITIONS)}.",
        Table(
            "errata_rows",
            "Rows in error, and a sound row that looks like an error: in the Nelder–Mead row of "
            "7.5 mm, 3 Hz, 1.5 A, k4 is positive, but because of k3, a3 and I1 the hysteresis "
            "velocity v_h/v_m is negative, as in all other rows. The last column is the norm of "
            "the difference between the loops of both methods.",
            "Condition | Method | Criteria failed | Half span [N] | Offset [N] | v_h/v_m [1] | "
            "Methods differ by [%]",
            rows,
        ),
        _loops(),
        Table(
            "errata_statements",
            "Statements that contradict numbers in the thesis.",
            "Statement | Stated | Found | Verdict",
            contradicted,
        ),
        "The second column of every table of appendix C says 0 A for all currents. The captions "
        "are correct, except for table 20, which belongs to 5.0 mm. The caption of figure 34 names "
        "the frequency, but the figure shows the displacement. Table 13 refers to figure 53 for a0 "
        "and a4, which are in figures 44 and 45. The printed routine overflows if its exponent is "
        "large: started from the literature set, it returns NaN within a few hundred evaluations.",
    )


def _loops() -> Picture:
    names = ("2.5mm_5Hz_0.0A", "7.5mm_5Hz_1.0A", "7.5mm_1Hz_1.5A", "7.5mm_3Hz_1.5A")
    picture, axes = chart(
        "errata",
        "Loops of the two methods in the conditions where they disagree and no table was copied. "
        "In all four the DE row is wrong: a force four times too large, a loop that is not "
        "dissipative (twice), and an offset with the wrong sign.",
        (1, len(names), 7.4, 2.3),
        *(ACROSS["velocity"], "Force [N]"),
    )
    for a, name in zip(axes[0], names, strict=True):
        for number, method in enumerate(PUBLISHED_METHODS):
            values = parameters(find(name), method)
            draw_loop(a, values, find(name), label=METHOD_TITLES[method], **line(number))
        a.set_title(title(name))
        a.locator_params(axis="x", nbins=3)
        a.locator_params(axis="y", nbins=5)
    axes[0, 0].legend(loc="upper left", fontsize=6.5, handlelength=1.6)
    return picture
