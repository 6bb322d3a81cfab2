"""The campaign as a process, with the emulated rig of a bridge: goals, commands, crashes."""

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mr_damper_msgs.action import RunCampaign
from mr_damper_msgs.msg import CurrentCommand, ExcitationCommand
from rclpy.action import ActionClient
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from support import Listener

from mr_damper_ros.campaign.folder import read_campaign_runs, read_steps
from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.nodes.command_topic import command_message, motion_of

MACHINE = {
    "model": "bingham",
    "machine.duration": 1.2,
    "machine.force": 5000.0,
    "machine.sample_rate": 500.0,
    "goal.lowest_peak_velocity": 0.06,
    "goal.highest_peak_velocity": 0.1,
    "goal.lowest_current": 1.0,
    "goal.highest_current": 1.5,
    "goal.error": 0.5,
}
"""A goal that few runs reach, with the law that is fastest to identify and to plan for."""


def rig(start: Any, folder: Path) -> Any:
    # A damper that follows the law.
    damper = folder.with_suffix(".yaml")
    values = np.array([600.0, 1500.0, 0.0, 0.5, 0.0, 0.0, 0.0])
    ParameterSet(values, model="bingham").save(damper)
    # The emulated rig runs this many times faster than a real one.
    return start(
        "bridge",
        rate=4.0,
        **{
            "emulated.damper": damper,
            "emulated.sample_rate": 500.0,
            "emulated.command_timeout": 2.0,
            "emulated.conductance": 1e4,
        },
    )


def campaign(start: Any, folder: Path, **more: object) -> Any:
    return start("campaign", folder=folder, **{**MACHINE, **more})


def runs_in(folder: Path) -> list[Path]:
    return sorted((folder / "runs").glob("run_*"))


def test_a_goal_is_reached_on_the_emulated_rig(
    start: Any, listener: Listener, tmp_path: Path
) -> None:
    motions = listener.listen(ExcitationCommand, "rig/excitation_command")
    currents = listener.listen(CurrentCommand, "supply/current_command")
    rig(start, tmp_path)
    node = campaign(start, tmp_path)
    client = ActionClient(listener.node, RunCampaign, "campaign/run_campaign")
    listener.until(client.server_is_ready, "the action")
    told: list[RunCampaign.Feedback] = []
    sent = client.send_goal_async(
        RunCampaign.Goal(), feedback_callback=lambda message: told.append(message.feedback)
    )
    listener.until(sent.done, "an answer to the goal")
    assert sent.result().accepted
    again = client.send_goal_async(RunCampaign.Goal())
    listener.until(again.done, "an answer to the second goal")
    assert not again.result().accepted
    answer = sent.result().get_result_async()
    listener.until(answer.done, "the end of the campaign", patience=120.0)
    result = answer.result().result
    assert result.outcome == RunCampaign.Result.MET, result.message
    assert result.runs == len(runs_in(tmp_path)) >= 1
    assert result.worst_error <= 0.5
    assert result.parameters.model == "bingham"
    assert len(result.parameters.values) == len(MODELS["bingham"].parameters)
    assert (tmp_path / "campaign.html").is_file()
    assert {message.stage for message in told} >= {
        RunCampaign.Feedback.SETTLING,
        RunCampaign.Feedback.IDENTIFYING,
    }
    assert all(0.0 <= command.amplitude <= 0.01 for command in motions)
    assert all(0.0 <= command.current <= 1.5 for command in currents)
    node.stop()
    listener.until(lambda: motions[-1].amplitude == currents[-1].current == 0.0, "the rest")
    client.destroy()


def test_killed_it_goes_on_where_it_was(start: Any, listener: Listener, tmp_path: Path) -> None:
    rig(start, tmp_path)
    node = campaign(start, tmp_path, autostart=True, most_runs=1)
    listener.until(lambda: runs_in(tmp_path), "the first run", patience=60.0)
    os.killpg(node.pid, signal.SIGKILL)
    node.wait()
    (first,) = runs_in(tmp_path)
    written = (first / "metadata.yaml").stat().st_mtime_ns
    campaign(start, tmp_path, autostart=True, most_runs=1)
    listener.until(
        lambda: (tmp_path / "campaign.html").exists(), "the end of the campaign", patience=120.0
    )
    assert (first / "metadata.yaml").stat().st_mtime_ns == written
    (run,), steps = read_campaign_runs(tmp_path), read_steps(tmp_path)
    assert len(steps) == 1
    assert run[1].temperature is not None


def test_it_pauses_resumes_and_stops(start: Any, listener: Listener, tmp_path: Path) -> None:
    motions = listener.listen(ExcitationCommand, "rig/excitation_command")
    rig(start, tmp_path)
    campaign(start, tmp_path, autostart=True)
    listener.until(lambda: motions and motions[-1].amplitude > 0.0, "a motion")
    assert listener.call(Trigger, "campaign/pause").success
    listener.until(lambda: motions[-1].amplitude == 0.0, "the rest")
    listener.wait_for_finding("campaign: campaign", "paused")
    assert listener.call(Trigger, "campaign/resume").success
    listener.until(lambda: motions[-1].amplitude > 0.0, "the motion again")
    assert listener.call(Trigger, "campaign/stop").success
    listener.wait_for_finding("campaign: campaign", "it was stopped")
    assert not listener.call(Trigger, "campaign/pause").success


def test_without_a_folder_a_goal_is_told_so(start: Any, listener: Listener) -> None:
    start("campaign")
    client = ActionClient(listener.node, RunCampaign, "campaign/run_campaign")
    listener.until(client.server_is_ready, "the action")
    sent = client.send_goal_async(RunCampaign.Goal())
    listener.until(sent.done, "an answer to the goal")
    answer = sent.result().get_result_async()
    listener.until(answer.done, "the result")
    result = answer.result().result
    assert result.outcome == RunCampaign.Result.FAILED
    assert "set the parameter folder" in result.message
    client.destroy()


@pytest.mark.parametrize(
    ("goal", "part"),
    [
        ({"error": float("nan")}, "the error of the goal is nan"),
        ({"lowest_current": -5.0}, "none below 0"),
    ],
)
def test_a_goal_that_cannot_be_meant_is_refused(
    start: Any, listener: Listener, tmp_path: Path, goal: dict[str, float], part: str
) -> None:
    node = campaign(start, tmp_path)
    client = ActionClient(listener.node, RunCampaign, "campaign/run_campaign")
    listener.until(client.server_is_ready, "the action")
    sent = client.send_goal_async(RunCampaign.Goal(**goal))
    listener.until(sent.done, "an answer to the goal")
    assert not sent.result().accepted
    listener.until(lambda: part in node.log, "the reason in the log")
    client.destroy()


@pytest.mark.parametrize(
    "motion",
    [
        None,
        PeriodicMotion(MotionKind.SINE, 0.01, 2.0),
        PeriodicMotion(MotionKind.SWEEP, 0.01, 0.5, 2.5, 4.0),
        PeriodicMotion(MotionKind.RANDOM, 0.01, 0.5, 2.5, 4.0, 7),
    ],
    ids=["rest", *(kind.value for kind in MotionKind)],
)
def test_a_motion_is_commanded_whole(motion: PeriodicMotion | None) -> None:
    assert motion_of(command_message(Header(), motion)) == motion


def test_a_motion_that_nobody_knows_is_no_motion() -> None:
    with pytest.raises(ValueError, match="the motion 3 is unknown"):
        motion_of(ExcitationCommand(amplitude=0.01, frequency=1.0, motion=3))
