"""Report of a campaign: one HTML page on the accuracy of the force after each run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.campaign.folder import (
    CampaignStep,
    CampaignTask,
    read_campaign_runs,
    read_steps,
    read_task,
)
from mr_damper_ros.estimation.experiment_design import PlanState
from mr_damper_ros.estimation.planned_run import PlannedRun
from mr_damper_ros.kinematics.periodic_motion import MotionKind
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.report.document import (
    DASHES,
    GREY,
    INK,
    WIDTH,
    Block,
    Chapter,
    Picture,
    Table,
    Text,
    legend_above,
    panels,
    styled,
    with_error,
    write_report,
)
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.error_sums import ErrorSums, pooled
from mr_damper_ros.signals.recording import Recording


@dataclass(frozen=True, eq=False)
class _Campaign:
    """The content of the folder of a campaign."""

    task: CampaignTask
    runs: list[tuple[PlannedRun, Recording]]
    steps: list[CampaignStep]
    refused: list[str]
    reason: str

    @property
    def last(self) -> CampaignStep:
        return self.steps[-1]

    @property
    def map(self) -> tuple[Array, Array, Array]:
        """Peak velocities (m,), currents (n,), and the relative standard errors (m, n)."""
        points = np.array(self.task.goal.points)
        speeds, currents = np.unique(points[:, 0]), np.unique(points[:, 1])
        return speeds, currents, self.last.plan.now.errors.reshape(speeds.size, currents.size)


@one_thread()
def write_campaign_report(folder: Path, reason: str = "") -> Path:
    """Write ``campaign.html`` with its figures and tables to the folder; returns the page.

    ``reason`` is the reason of the end, in words. Raises ValueError if the folder holds no campaign
    or no result yet.
    """
    task = read_task(folder)
    steps = read_steps(folder)
    if not steps:
        raise ValueError(f"{folder} holds no run from which something was found yet")
    refused = sorted(path.name for path in (folder / "runs").glob("refused_*"))
    runs = read_campaign_runs(folder)[: len(steps)]
    campaign = _Campaign(task, runs, steps, refused, reason or steps[-1].plan.reason)
    with styled():
        chapters = [
            Chapter("plan", "The runs that were made", _plan(campaign)),
            Chapter("error", "The error, run by run", _error(campaign)),
            Chapter("map", "Where the force is known", _map(campaign)),
            Chapter("loops", "Measured and predicted loops", _loops(campaign)),
            Chapter("set", "The set", _set(campaign)),
            Chapter("unknown", "What is still unknown", _unknown(campaign)),
        ]
        return write_report(
            folder,
            "A damper becomes known",
            _notice(campaign),
            _headlines(campaign),
            chapters,
            page="campaign.html",
        )


def _notice(campaign: _Campaign) -> str:
    goal, limits = campaign.task.goal, campaign.task.limits
    heat = "" if math.isinf(limits.heat) else f", {limits.heat:g} J a run"
    return (
        f"Wanted: the force to {goal.error:.2%} at the worst point, from "
        f"{goal.peak_velocity[0]:g} to {goal.peak_velocity[1]:g} m/s peak velocity and from "
        f"{goal.current[0]:g} to {goal.current[1]:g} A. The machine: "
        f"{1e3 * limits.amplitude:g} mm, {limits.peak_velocity:g} m/s, {limits.force:g} N, "
        f"{limits.current:g} A, {limits.duration:g} s a run{heat}. Law: {campaign.task.model}. "
        "Errors are relative to the largest force of a cycle, and about the law: what a damper "
        "does beyond its law is not in them."
    )


def _headlines(campaign: _Campaign) -> list[str]:
    plan = campaign.last.plan
    time = sum(run.duration for run, _ in campaign.runs)
    refused = f", {len(campaign.refused)} refused" if campaign.refused else ""
    total = _errors_of_runs(campaign)
    seen = int(np.sum(campaign.last.parameter_set.observable))
    count = campaign.last.parameter_set.values.size
    speed, current = plan.now.worst_point
    return [
        f"{len(campaign.runs)} runs{refused}, {time:.3g} s of steady motion; {campaign.reason}",
        f"{plan.now.sentence}, where {campaign.task.goal.error:.2%} is wanted",
        f"least at {speed:.3g} m/s and {current:.3g} A",
        f"the set leaves {total.nrmse:.2%} of the measured force (NRMSE)",
        f"{seen} of {count} parameters were determined by themselves",
        "nothing that matters for the goal"
        if plan.state is PlanState.MET
        else f"the force, to {plan.now.worst:.2%} instead of {campaign.task.goal.error:.2%}",
    ]


def _plan(campaign: _Campaign) -> list[Block]:
    rows = []
    expected = math.nan
    for number, step in enumerate(campaign.steps, start=1):
        run, plan = step.run, step.plan
        rows.append(
            (
                number,
                1e3 * run.amplitude,
                run.frequency,
                "–" if run.kind is MotionKind.SINE else run.highest_frequency,
                run.kind.description,
                run.peak_velocity,
                ", ".join(f"{current:g}" for current in run.currents),
                _percent(expected),
                _percent(plan.now.worst),
                "–" if plan.runs_left is None else plan.runs_left,
            )
        )
        expected = plan.expected
    table = Table(
        "plan",
        "Each run was chosen after those before it. Expected: the worst error that the plan "
        "foresaw for after the run. Left: runs that were then expected to be needed still.",
        (
            "run",
            "amplitude [mm]",
            "frequency [Hz]",
            "up to [Hz]",
            "motion",
            "peak velocity [m/s]",
            "currents [A]",
        )
        + ("expected", "worst error", "left"),
        rows,
    )
    if not campaign.refused:
        return [table]
    names = ", ".join(campaign.refused)
    return [table, Text(f"Refused, stored as bags and repeated: {names}.")]


def _frequency(run: PlannedRun) -> str:
    if run.kind is MotionKind.SINE:
        return f"{run.frequency:g}"
    return f"{run.frequency:g} to {run.highest_frequency:g}"


def _percent(value: float) -> str:
    return f"{100.0 * value:.2f} %" if math.isfinite(value) else "–"


def _error(campaign: _Campaign) -> list[Block]:
    figure, axes = panels(1, 1, WIDTH, 3.0)
    axis = axes[0, 0]
    numbers = np.arange(1, len(campaign.steps) + 1)
    errors = 100.0 * np.stack([step.plan.now.errors for step in campaign.steps])
    axis.plot(numbers, errors, "-", color=GREY, linewidth=0.5)
    worst = [100.0 * step.plan.now.worst for step in campaign.steps]
    expected = [100.0 * step.plan.expected for step in campaign.steps]
    axis.plot(numbers, worst, "o-", color=INK[0], label="worst error")
    axis.plot(numbers[1:], expected[:-1], "s", color=INK[1], fillstyle="none", label="expected")
    goal = 100.0 * campaign.task.goal.error
    axis.axhline(goal, color=INK[2], linestyle=DASHES[1], label="wanted")
    axis.set_yscale("log")
    axis.yaxis.set_major_formatter("{x:g}")
    axis.set_xticks(numbers)
    axis.set_xlabel("run")
    axis.set_ylabel("relative error [%]")
    legend_above(figure, axis, 3)
    return [
        Picture(
            "error",
            "The worst error that is as likely exceeded as not, after each run, and what the plan "
            "before had expected. Grey: the standard error at each operating point.",
            figure,
        )
    ]


def _map(campaign: _Campaign) -> list[Block]:
    speeds, currents, errors = campaign.map
    figure, axes = panels(1, 1, WIDTH, 3.6)
    axis = axes[0, 0]
    percent = 100.0 * errors
    # Cells of equal size, so that the numbers are readable.
    image = axis.imshow(percent.T, origin="lower", aspect="auto", cmap="Greys", vmin=0.0)
    dark = 0.55 * float(np.max(percent))
    for row, column in np.ndindex(percent.shape):
        value = percent[row, column]
        axis.text(
            row,
            column,
            f"{value:.2g}",
            ha="center",
            va="center",
            color="white" if value > dark else "black",
        )
    _mark_runs(axis, campaign, speeds, currents)
    axis.set_xticks(range(speeds.size), [f"{speed:.3g}" for speed in speeds])
    axis.set_yticks(range(currents.size), [f"{current:.3g}" for current in currents])
    axis.set_xlabel("peak velocity [m/s]")
    axis.set_ylabel("current [A]")
    figure.colorbar(image, label="standard error [%]")
    caption = (
        "Relative standard error of the force [%] at each operating point of the goal, the "
        "largest of the cycle. Circles: where the runs were made."
    )
    return [Picture("map", caption, figure)]


def _mark_runs(axis: Any, campaign: _Campaign, speeds: Array, currents: Array) -> None:
    places = np.arange(speeds.size), np.arange(currents.size)
    made = np.array(
        [(run.peak_velocity, i) for run, _ in campaign.runs for i in run.currents], dtype=float
    )
    across = np.interp(np.log(made[:, 0]), np.log(speeds), places[0])
    up = np.interp(made[:, 1], currents, places[1])
    axis.plot(across, up, "o", color=INK[1], fillstyle="none", markersize=14, markeredgewidth=0.8)


def _loops(campaign: _Campaign) -> list[Block]:
    found = campaign.last.parameter_set
    count = len(campaign.runs)
    columns = min(3, count)
    rows = -(-count // columns)
    figure, axes = panels(rows, columns, WIDTH, 0.5 + 2.1 * rows)
    for axis in axes.flat[count:]:
        axis.set_axis_off()
    for number, ((run, recording), axis) in enumerate(
        zip(campaign.runs, axes.flat, strict=False), start=1
    ):
        for place, window in enumerate(run.windows(recording)):
            velocity = window.motion.velocity
            every = max(velocity.size // 400, 1)
            axis.plot(velocity[::every], 1e-3 * window.force[::every], ".", color=GREY, ms=1.5)
            predicted = found.window_force(window, gradual=None)
            cycle = slice(0, min(round(1.0 / (run.frequency * window.period)) + 1, velocity.size))
            axis.plot(
                velocity[cycle],
                1e-3 * predicted[cycle],
                color=INK[place % len(INK)],
                linestyle=DASHES[place % len(DASHES)],
                linewidth=0.9,
            )
        axis.set_title(f"{number}: {1e3 * run.amplitude:g} mm, {_frequency(run)} Hz")
        axis.set_xlabel("velocity [m/s]")
        axis.set_ylabel("force [kN]")
    caption = (
        "Dots: measured. Lines: predicted by the final set, one for each current of the run, in "
        "the order of the plan (black, red, blue and so on)."
    )
    return [Picture("loops", caption, figure), _fit_table(campaign)]


def _fit_table(campaign: _Campaign) -> Table:
    rows = []
    for number, (run, recording) in enumerate(campaign.runs, start=1):
        error = _error_of(campaign, run, recording)
        rows.append((number, error.rmse, f"{100.0 * error.nrmse:.2f} %", error.count))
    return Table(
        "fits",
        "What the final set leaves of the force of each run.",
        ("run", "RMSE [N]", "NRMSE", "samples"),
        rows,
    )


def _error_of(campaign: _Campaign, run: PlannedRun, recording: Recording) -> ErrorSums:
    found = campaign.last.parameter_set
    windows = run.windows(recording)
    predicted = np.concatenate([found.window_force(window, gradual=None) for window in windows])
    return ErrorSums.of(predicted, np.concatenate([window.force for window in windows]))


def _errors_of_runs(campaign: _Campaign) -> ErrorSums:
    return pooled(_error_of(campaign, run, recording) for run, recording in campaign.runs)


def _set(campaign: _Campaign) -> list[Block]:
    found = campaign.last.parameter_set
    rows = []
    for parameter, value, error, seen in zip(
        found.law.parameters, found.values, found.standard_errors, found.observable, strict=True
    ):
        known = seen and error > 0.0
        rows.append(
            (
                parameter.name,
                parameter.unit,
                with_error(float(value), float(error)) if known else float(value),
                "yes" if seen else "no",
            )
        )
    table = Table(
        "set",
        "Maximum-a-posteriori values, with standard errors of the parameters that the runs "
        "determine. The force hardly depends on the others, which may be wrong.",
        ("parameter", "unit", "value", "determined"),
        rows,
    )
    return [Text("It is kept as set.yaml, for the nodes and for every program."), table]


def _unknown(campaign: _Campaign) -> list[Block]:
    plan, found = campaign.last.plan, campaign.last.parameter_set
    points, errors = plan.now.points, plan.now.errors
    order = np.argsort(-errors)[:5]
    rows = [(points[k][0], points[k][1], _percent(float(errors[k]))) for k in order]
    blocks: list[Block] = [
        Table(
            "least-known",
            "The operating points at which the force is known least.",
            ("peak velocity [m/s]", "current [A]", "standard error"),
            rows,
        )
    ]
    unseen = [
        name
        for name, seen in zip(found.law.parameter_names, found.observable, strict=True)
        if not seen
    ]
    if unseen:
        blocks.append(Text(f"Not determined by themselves: {', '.join(unseen)}."))
    if plan.run is not None:
        blocks.append(Text(f"The next run would be {plan.run.sentence}."))
    blocks.append(
        Text(
            "Not covered: motions and temperatures other than those of the runs, and operating "
            "points outside the range of the goal."
        )
    )
    return blocks
