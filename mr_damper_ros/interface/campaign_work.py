"""What a campaign computes in a process of its own."""

from __future__ import annotations

from pathlib import Path

from mr_damper_ros.interface.campaign_course import RunWork, StepWork
from mr_damper_ros.interface.campaign_folder import CampaignStep
from mr_damper_ros.processes.worker import Control


def judge_run(work: RunWork, control: Control) -> str:
    """Judge and keep a run; returns why it is refused, empty where it is not."""
    return work.carry_out()


def find_step(work: StepWork, control: Control) -> CampaignStep:
    """Identify from the runs so far, and plan the next."""
    return work.carry_out()


def report_campaign(folder: Path, reason: str, control: Control) -> Path:
    """Write the report of a campaign; returns its page."""
    from mr_damper_ros.interface.campaign_report import write_campaign_report

    return write_campaign_report(folder, reason)
