"""Bridge on one machine, identifier and model on another, and a bad network between them."""

from __future__ import annotations

from contextlib import ExitStack, closing

from benchmarks.figure import Figure
from benchmarks.network import LossyLink, NetworkError
from benchmarks.processes import ProfiledDomain, start_node
from benchmarks.streaming_load import Tally
from mr_damper_ros.nodes.observer import Observer
from mr_damper_ros.processes.programs import PATIENCE

DURATION = 60.0
SAMPLE_RATE = 1000.0
LOSS = 0.05
DELAY = 0.02


class NetworkDomain(ProfiledDomain):
    """A domain that spans the machines of a network.

    Processes on one computer would pass messages through its memory, not through the network.
    """

    @property
    def environment(self) -> dict[str, str]:
        """As for a domain on one computer, but for the network."""
        return {
            **super().environment,
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
            "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
        }


def measure(duration: float, loss: float = LOSS, delay: float = DELAY) -> tuple[Tally, str]:
    """What is lost in ``duration`` [s], and how many frames the link dropped, in words.

    Raises NetworkError where there can be no such link.
    """
    with ExitStack() as stack:
        link = stack.enter_context(closing(LossyLink(loss, delay)))
        domain = stack.enter_context(closing(NetworkDomain()))
        # Here the observer hears what was sent, and the predictions after two ways over the link.
        with link.inside("left"):
            observer = stack.enter_context(closing(Observer(domain=domain)))
        tally = Tally(observer)
        with link.inside("right"):
            stack.enter_context(closing(start_node("identifier", domain)))
            # What was sent again comes late; here every block's force is to come, late or not.
            stack.enter_context(closing(start_node("model", domain, newest_first=False)))
        observer.wait_for_publishers("damper/predicted_force")
        observer.wait_for_publishers("damper/fit_report")
        with link.inside("left"):
            bridge = start_node(
                "bridge",
                domain,
                emulated__sample_rate=SAMPLE_RATE,
                wait_for_subscribers=3,
                wait_timeout=PATIENCE,
            )
        stack.enter_context(closing(bridge))
        tally.wait_for(round(SAMPLE_RATE * duration), 1.5 * duration + PATIENCE)
        tally.finish()
        return tally, f"{link.dropped} of {link.frames} frames dropped"


def figures(duration: float = DURATION) -> list[Figure]:
    """``lossy_link_lost``."""
    definition = (
        f"Samples lost in {duration:g} s at 1 kHz in blocks of 10, bridge and subscriber in one "
        f"network namespace, identifier and model in another, the link between them with "
        f"{LOSS:.0%} loss and {1e3 * DELAY:g} ms delay."
    )
    try:
        tally, dropped = measure(duration)
    except NetworkError as error:
        return [Figure("lossy_link_lost", None, definition, (0.0, 0.0), str(error))]
    note = f"{tally.where}; {dropped}; {len(tally.fits)} fits."
    return [Figure("lossy_link_lost", tally.lost, definition, (0.0, 0.0), note)]
