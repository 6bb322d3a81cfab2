"""Report of a campaign: one HTML page on the accuracy of the force after each run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mr_damper_ros.api.details import estimates_table, parameter_estimates
from mr_damper_ros.campaign.folder import (
    CampaignStep,
    CampaignTask,
    MadeRun,
    read_campaign_runs,
    read_steps,
    read_task,
)
from mr_damper_ros.estimation.experiment_design import PlanState
from mr_damper_ros.kinematics.periodic_motion import MotionKind
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.worker import Control
from mr_damper_ros.report.document import (
    DASHES,
    GREY,
    INK,
    WIDTH,
    Block,
    Chapter,
    Table,
    chart,
    legend_above,
    styled,
    write_report,
)
from mr_damper_ros.signals.error_sums import ErrorSums, pooled


@one_thread()
def write_campaign_report(folder: Path, reason: str = "", control: Control | None = None) -> Path:
    """Write ``campaign.html`` with its figures and tables to the folder; returns the page.

    ``reason`` says in words why the campaign ended. This function can run in a worker, like
    :func:`find_step`. Raises ValueError if the folder holds no campaign or no result yet.
    """
    task = read_task(folder)
    steps = read_steps(folder)
    if not steps:
        raise ValueError(f"{folder} holds no identified run yet")
    runs = read_campaign_runs(folder)[: len(steps)]
    refused = sorted(path.name for path in (folder / "runs").glob("refused_*"))
    with styled():
        chapters = [
            Chapter("plan", "The runs that were made", *_plan(steps, refused, reason)),
            Chapter("error", "The error, run by run", *_error(steps, task.goal.error)),
            Chapter(
                "map", "Accuracy of the force by operating point", *_map(task, steps[-1], runs)
            ),
            Chapter("loops", "Measured and predicted loops", *_loops(steps[-1], runs)),
            Chapter("set", "The set", *_set(steps[-1].parameter_set)),
            Chapter("unknown", "What is not determined", *_unknown(steps[-1], task.goal.error)),
        ]
        title = "Campaign of identification runs"
        return write_report(folder, title, _notice(task), chapters, page="campaign.html")


def _notice(task: CampaignTask) -> str:
    goal, limits = task.goal, task.limits
    heat = "" if math.isinf(limits.heat) else f", {limits.heat:g} J a run"
    return (
        f"Goal: an error of {goal.error:.2%} of the force at the worst point, from "
        f"{goal.peak_velocity[0]:g} to {goal.peak_velocity[1]:g} m/s peak velocity and from "
        f"{goal.current[0]:g} to {goal.current[1]:g} A. Limits of the machine: "
        f"{1e3 * limits.amplitude:g} mm, {limits.peak_velocity:g} m/s, {limits.force:g} N, "
        f"{limits.current:g} A, {limits.duration:g} s a run{heat}. Law: {task.model}. "
        "Errors are relative to the largest force of a cycle and include the model error."
    )


def _percent(value: float) -> str:
    return f"{100.0 * value:.2f} %" if math.isfinite(value) else "–"


_Part = tuple[str, list[Block]]
"""Headline and content of a chapter."""


def _plan(steps: Sequence[CampaignStep], refused: Sequence[str], reason: str) -> _Part:
    headline = (
        f"{len(steps)} runs{f', {len(refused)} rejected' if refused else ''}, "
        f"{sum(step.run.duration for step in steps):.3g} s of steady motion; "
        f"{reason or steps[-1].plan.reason}"
    )
    expected = [math.nan, *(step.plan.expected for step in steps)]
    rows = [
        (
            number,
            1e3 * step.run.amplitude,
            step.run.frequency,
            "–" if step.run.kind is MotionKind.SINE else step.run.highest_frequency,
            step.run.kind.description,
            step.run.peak_velocity,
            ", ".join(f"{current:g}" for current in step.run.currents),
            _percent(expected[number - 1]),
            _percent(step.plan.now.worst),
            step.plan.runs_left,
        )
        for number, step in enumerate(steps, start=1)
    ]
    table = Table(
        "plan",
        "Each run was chosen from the results of the runs before it. Expected: the worst error "
        "after the run, as predicted by the plan. Left: the number of further runs that were then "
        "expected to be needed.",
        "run | amplitude [mm] | frequency [Hz] | up to [Hz] | motion | peak velocity [m/s] | "
        "currents [A] | expected | worst error | left",
        rows,
    )
    if not refused:
        return headline, [table]
    return headline, [table, f"Rejected runs, stored as bags and repeated: {', '.join(refused)}."]


def _error(steps: Sequence[CampaignStep], goal: float) -> _Part:
    picture, ((axis,),) = chart(
        "error",
        "The median of the worst error after each run, and the value that the plan had predicted. "
        "Grey: the standard error at each operating point.",
        (1, 1, WIDTH, 3.0),
        *("run", "relative error [%]"),
    )
    numbers = np.arange(1, len(steps) + 1)
    errors, worst, expected = (
        100.0 * np.array(values)
        for values in (
            [step.plan.now.errors for step in steps],
            [step.plan.now.worst for step in steps],
            [step.plan.expected for step in steps],
        )
    )
    axis.plot(numbers, errors, "-", color=GREY, linewidth=0.5)
    axis.plot(numbers, worst, "o-", color=INK[0], label="worst error")
    axis.plot(numbers[1:], expected[:-1], "s", color=INK[1], fillstyle="none", label="expected")
    axis.axhline(100.0 * goal, color=INK[2], linestyle=DASHES[1], label="wanted")
    axis.set_yscale("log")
    axis.yaxis.set_major_formatter("{x:g}")
    axis.set_xticks(numbers)
    legend_above(axis, 3)
    return f"{steps[-1].plan.now.sentence}; the goal is {goal:.2%}", [picture]


def _map(task: CampaignTask, last: CampaignStep, runs: Sequence[MadeRun]) -> _Part:
    speeds, currents = (np.unique(values) for values in zip(*task.goal.points, strict=True))
    percent = 100.0 * last.plan.now.errors.reshape(speeds.size, currents.size)
    picture, ((axis,),) = chart(
        "map",
        "Relative standard error of the force [%] at each operating point of the goal, the "
        "largest within a cycle. Circles: operating points of the runs.",
        (1, 1, WIDTH, 3.6),
        *("peak velocity [m/s]", "current [A]"),
    )
    # Cells of equal size, so that the numbers are readable.
    image = axis.imshow(percent.T, origin="lower", aspect="auto", cmap="Greys", vmin=0.0)
    for (row, column), value in np.ndenumerate(percent):
        color = "white" if value > 0.55 * percent.max() else "black"
        axis.text(row, column, f"{value:.2g}", ha="center", va="center", color=color)
    made = np.array([(run.peak_velocity, i) for run, _ in runs for i in run.currents])
    axis.plot(
        np.interp(np.log(made[:, 0]), np.log(speeds), np.arange(speeds.size)),
        np.interp(made[:, 1], currents, np.arange(currents.size)),
        "o",
        color=INK[1],
        fillstyle="none",
        markersize=14,
        markeredgewidth=0.8,
    )
    axis.set_xticks(range(speeds.size), [f"{speed:.3g}" for speed in speeds])
    axis.set_yticks(range(currents.size), [f"{current:.3g}" for current in currents])
    picture.figure.colorbar(image, label="standard error [%]")
    speed, current = last.plan.now.worst_point
    return f"least accurate at {speed:.3g} m/s and {current:.3g} A", [picture]


def _loops(last: CampaignStep, runs: Sequence[MadeRun]) -> _Part:
    """Figure and table of the fits of the last set to the runs."""
    columns = min(3, len(runs))
    rows = -(-len(runs) // columns)
    picture, axes = chart(
        "loops",
        "Dots: measured. Lines: predicted by the final set, one for each current of the run, in "
        "the order of the plan (black, red, blue and so on).",
        (rows, columns, WIDTH, 0.5 + 2.1 * rows),
    )
    for axis in axes.flat[len(runs) :]:
        axis.set_axis_off()
    errors = []
    for (run, recording), axis in zip(runs, axes.flat, strict=False):
        windows = run.windows(recording)
        forces = [last.parameter_set.window_force(window, gradual=None) for window in windows]
        measured = np.concatenate([window.force for window in windows])
        errors.append(ErrorSums.of(np.concatenate(forces), measured))
        for place, (window, predicted) in enumerate(zip(windows, forces, strict=True)):
            velocity = window.motion.velocity
            few = window.thinned(400)
            axis.plot(few.motion.velocity, 1e-3 * few.force, ".", color=GREY, ms=1.5)
            cycle = slice(0, min(round(1.0 / (run.frequency * window.period)) + 1, velocity.size))
            axis.plot(
                velocity[cycle],
                1e-3 * predicted[cycle],
                color=INK[place % len(INK)],
                linestyle=DASHES[place % len(DASHES)],
                linewidth=0.9,
            )
        band = "" if run.kind is MotionKind.SINE else f" to {run.highest_frequency:g}"
        title = f"{len(errors)}: {1e3 * run.amplitude:g} mm, {run.frequency:g}{band} Hz"
        axis.set(title=title, xlabel="velocity [m/s]", ylabel="force [kN]")
    table = Table(
        "fits",
        "Errors of the final set in each run.",
        "run | RMSE [N] | NRMSE | samples",
        [
            (number, error.rmse, f"{100.0 * error.nrmse:.2f} %", error.count)
            for number, error in enumerate(errors, start=1)
        ],
    )
    headline = f"NRMSE of the set over all runs: {pooled(errors).nrmse:.2%}"
    return headline, [picture, table]


def _set(found: ParameterSet) -> _Part:
    known = int(np.sum(found.observable))
    headline = f"{known} of {found.values.size} parameters were determined"
    columns, rows = estimates_table("parameter", parameter_estimates(found))
    table = Table(
        "set",
        "Maximum-a-posteriori values, with standard errors of the parameters that the runs "
        "determine. The other values may be wrong, but hardly affect the force.",
        columns,
        rows,
    )
    return headline, ["The set is stored as set.yaml, for the nodes and all programs.", table]


def _unknown(last: CampaignStep, goal: float) -> _Part:
    headline = f"the error of the force is {last.plan.now.worst:.2%} instead of {goal:.2%}"
    if last.plan.state is PlanState.MET:
        headline = "nothing that matters for the goal"
    points, errors = last.plan.now.points, last.plan.now.errors
    blocks: list[Block] = [
        Table(
            "least-known",
            "The operating points with the least accurate force.",
            "peak velocity [m/s] | current [A] | standard error",
            [(*points[k], _percent(float(errors[k]))) for k in np.argsort(-errors)[:5]],
        )
    ]
    found = last.parameter_set
    unseen = np.array(found.law.parameter_names)[~np.asarray(found.observable, dtype=bool)]
    if unseen.size:
        blocks.append(f"Parameters not determined: {', '.join(unseen)}.")
    if last.plan.run is not None:
        blocks.append(f"The next run would be {last.plan.run.sentence}.")
    blocks.append(
        "Not covered: motions and temperatures other than those of the runs, and operating points "
        "outside the range of the goal."
    )
    return headline, blocks
