"""The SROS2 policy allows each node its own topics and services, and nothing else."""

import contextlib
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest
from rclpy.node import NodeNameNonExistentError
from support import Listener

POLICY = Path(__file__).parents[2] / "config" / "security" / "policy.xml"
ROOT = Path(__file__).parents[2]
NODES = (
    *("bridge", "campaign", "controller", "identifier", "live", "model", "replay", "supply"),
    "suspension",
)
CONCERNS = {"bridge": "source", "replay": "replay", "supply": "supply", "suspension": "force"}

ACTION_TOPICS = ("feedback", "status")
ACTION_SERVICES = ("cancel_goal", "get_result", "send_goal")


def allowed(node: str) -> dict[str, set[str]]:
    """Full names that the policy allows a node, by kind of access."""
    enclave = ElementTree.parse(POLICY).find(f"enclaves/enclave[@path='/mr_damper/{node}']")
    (profile,) = enclave.findall("profiles/profile")
    assert (profile.get("ns"), profile.get("node")) == ("/", node)
    names: dict[str, set[str]] = {"publish": set(), "subscribe": set(), "reply": set()}
    for group in profile:
        ((qualifier, rule),) = group.attrib.items()
        assert rule == "ALLOW"
        for entry in group:
            name = _full_name(entry.text or "", node)
            if qualifier == "execute":
                names["publish"] |= {f"{name}/_action/{topic}" for topic in ACTION_TOPICS}
                names["reply"] |= {f"{name}/_action/{service}" for service in ACTION_SERVICES}
            else:
                names[qualifier].add(name)
    return names


def _full_name(name: str, node: str) -> str:
    if name.startswith("~"):
        return f"/{node}{name[1:]}"
    return name if name.startswith("/") else f"/{name}"


def done(listener: Listener, node: str) -> dict[str, set[str]]:
    """Topics and services of a running node in the graph; empty until the node is discovered."""
    graph = listener.node
    found: dict[str, set[str]] = {"publish": set(), "subscribe": set(), "reply": set()}
    ways = (
        graph.get_publisher_names_and_types_by_node,
        graph.get_subscriber_names_and_types_by_node,
        graph.get_service_names_and_types_by_node,
    )
    with contextlib.suppress(NodeNameNonExistentError):
        for names, way in zip(found.values(), ways, strict=True):
            names |= {name for name, _ in way(node, "/")}
    return found


@pytest.mark.parametrize("node", NODES)
def test_a_node_is_allowed_exactly_what_it_does(start: Any, listener: Listener, node: str) -> None:
    given: dict[str, dict[str, object]] = {
        "live": {"port": 0, "use_sim_time": True},
        "replay": {"bag": ROOT / "bags" / "5.0mm_1Hz_1.5A", "start_paused": True},
    }
    start(node, **given.get(node, {"use_sim_time": True}))
    wanted = allowed(node)
    if node == "replay":
        wanted["publish"] -= {"/temperature"}  # this bag has none
    listener.until(
        lambda: all(wanted[what] <= names for what, names in done(listener, node).items()),
        f"all that the policy allows: {wanted}",
    )
    if node != "live":
        listener.wait_for_finding(f"{node}: {CONCERNS.get(node, 'input')}", "")
    assert done(listener, node) == wanted


def test_every_node_has_an_enclave_of_its_own() -> None:
    root = ElementTree.parse(POLICY).getroot()
    assert (root.tag, root.get("version")) == ("policy", "0.2.0")
    paths = [enclave.get("path") for enclave in root.findall("enclaves/enclave")]
    assert sorted(paths) == sorted(f"/mr_damper/{node}" for node in NODES)
