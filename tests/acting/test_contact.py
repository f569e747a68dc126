"""Contacts: deep inside, ranked, measured where depth allows it, with a reason where it does not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from a4agent.acting.contact import contact_points
from a4agent.acting.lifting import Intrinsics

CAMERA = Intrinsics(500.0, 500.0, 79.5, 59.5)
SHAPE = (120, 160)


def disc(x: float, y: float, radius: float) -> np.ndarray:
    rows, columns = np.indices(SHAPE)
    return np.hypot(columns + 0.5 - x, rows + 0.5 - y) < radius


def test_the_first_contact_is_the_centre_of_the_largest_circle() -> None:
    mask = disc(50, 60, 20) | disc(110, 60, 10)
    mask[58:62, 50:110] = True
    first, second, *_ = contact_points(mask)
    np.testing.assert_allclose(first.point_xy, [50, 60], atol=1.5)
    np.testing.assert_allclose(second.point_xy, [110, 60], atol=1.5)
    assert first.clearance == pytest.approx(20, abs=1.5)
    assert first.position_xyz is None
    assert first.reason == ""


def test_a_ring_is_touched_on_its_band_and_not_in_its_hole() -> None:
    mask = disc(80, 60, 40) & ~disc(80, 60, 25)
    for contact in contact_points(mask, count=4):
        column, row = contact.point_xy.astype(int)
        assert mask[row, column]


@given(st.integers(0, 2**32 - 1))
def test_contacts_lie_in_the_mask(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mask = rng.random((20, 30)) < rng.random()
    contacts = contact_points(mask)
    assert bool(contacts) == bool(mask.any())
    for contact in contacts:
        column, row = contact.point_xy.astype(int)
        assert mask[row, column]


def tilted_plane(degrees: float) -> np.ndarray:
    """Depth (H, W) of a plane half a metre away, turned about the vertical axis."""
    _, columns = np.indices(SHAPE)
    slope = np.tan(np.radians(degrees))
    return 0.5 / (1 - slope * (columns - CAMERA.cx) / CAMERA.fx)


@pytest.mark.parametrize("degrees", [0.0, 20.0, 45.0])
def test_position_and_normal_on_a_plane(degrees: float) -> None:
    contact = contact_points(disc(80, 60, 20), tilted_plane(degrees), CAMERA)[0]
    assert contact.position_xyz is not None
    assert contact.normal_xyz is not None
    assert contact.approach_xyz is not None
    np.testing.assert_allclose(contact.position_xyz, [0, 0, 0.5], atol=0.005)
    expected = np.array([np.sin(np.radians(degrees)), 0, -np.cos(np.radians(degrees))])
    assert float(contact.normal_xyz @ expected) > 0.995
    np.testing.assert_allclose(contact.approach_xyz, -contact.normal_xyz)
    assert contact.reachable


def test_what_was_not_measured_has_a_reason() -> None:
    mask = disc(80, 60, 20)
    holes = np.full(SHAPE, np.nan)
    assert "no depth was measured" in contact_points(mask, holes, CAMERA)[0].reason
    holes[60, 76:80] = 0.5
    few = contact_points(mask, holes, CAMERA)[0]
    assert "only 4 pixels" in few.reason
    assert few.position_xyz is None
    edge_on = contact_points(mask, tilted_plane(80.0), CAMERA)[0]
    assert not edge_on.reachable
    assert edge_on.reason


def test_measured_contacts_come_first() -> None:
    mask = disc(50, 60, 20) | disc(120, 60, 12)
    depth = np.full(SHAPE, 0.5)
    depth[:, :80] = np.nan
    first = contact_points(mask, depth, CAMERA)[0]
    assert first.point_xy[0] > 100
