"""Origin and domain of a parameter set."""

import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from known import PLAUSIBLE

from mr_damper_ros.models.domain import Domain, Origin
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet, start_set

MESSAGE = Path(__file__).resolve().parents[2] / "msg_defs" / "msg" / "DamperParameters.msg"

spans = st.tuples(st.floats(0.0, 2.0), st.floats(0.0, 2.0)).map(lambda x: (min(x), max(x)))
domains = st.builds(Domain, spans, spans, st.none() | st.integers(0, 9))


@given(domains, domains)
def test_a_joined_domain_covers_both(one: Domain, other: Domain) -> None:
    joined = one.joined(other)
    for each in (one, other):
        assert joined.covers(each)
        assert joined.covers_speeds(each, 1.0)
        assert each.confirmed_ns is None or joined.confirmed_ns >= each.confirmed_ns


@given(domains, st.floats(-0.5, 2.5))
def test_what_is_inside_a_covered_domain_is_inside_the_covering_one(
    one: Domain, current: float
) -> None:
    wider = one.joined(Domain((0.5, 1.0), (0.5, 1.0)))
    assert wider.contains(current) or not one.contains(current)


def test_an_unbounded_domain_is_covered_where_it_has_ends() -> None:
    assert Domain(currents=(0.0, 1.0)).covers(Domain())
    assert not Domain(currents=(0.5, 1.0)).covers(Domain(currents=(0.0, math.inf)))


def test_the_message_has_the_numbers_of_the_origins() -> None:
    constants = re.findall(r"^uint8 ([A-Z]+) = (\d)", MESSAGE.read_text("utf-8"), re.MULTILINE)
    assert {name: int(value) for name, value in constants} == dict(Origin.__members__)


@pytest.mark.parametrize("origin", [*Origin])
def test_a_file_keeps_the_origin_and_a_user_who_loads_it_is_its_origin(origin: Origin) -> None:
    made = ParameterSet(PLAUSIBLE, origin=origin, stamp_ns=5)
    assert ParameterSet.from_yaml(made.to_yaml()).origin is origin
    assert made.as_given().origin is (Origin.USER if origin.is_evidence else origin)
    assert made.domain.confirmed_ns == (5 if origin.is_identified else None)
    assert made.as_given().domain.confirmed_ns is None


def test_an_unknown_origin_is_refused_with_the_known_ones() -> None:
    text = ParameterSet(PLAUSIBLE).to_yaml().replace("origin: user", "origin: me")
    with pytest.raises(ParameterError, match="literature, user"):
        ParameterSet.from_yaml(text)


def test_start_sets_are_no_evidence() -> None:
    assert start_set("sigmoid").origin is Origin.LITERATURE
    assert start_set("bingham").origin is Origin.START
    assert replace(start_set("sigmoid"), set_id="mine").as_given().origin is Origin.LITERATURE
