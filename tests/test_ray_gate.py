"""A gate lets in what there is room for, the same again, and nothing new once it is closed."""

from __future__ import annotations

from a4agent.ray_gate import Gate


def test_there_is_room_for_so_many() -> None:
    gate = Gate(room=5)
    assert gate.enter([0, 1, 2]) is True
    assert gate.enter([3, 4, 5]) is None
    assert gate.enter([3, 4]) is True
    assert gate.leave([0]) == 4
    assert gate.enter([5]) is True
    gate.resize(3)
    assert gate.leave([1, 2]) == 3
    assert gate.enter([6]) is None
    gate.resize(4)
    assert gate.enter([6]) is True


def test_a_batch_larger_than_the_room_goes_alone() -> None:
    gate = Gate(room=2)
    assert gate.enter([0, 1, 2]) is True
    assert gate.enter([3]) is None
    assert gate.leave([0, 1, 2]) == 0
    assert gate.enter([3, 4, 5]) is True


def test_closed_it_lets_in_only_what_is_under_way() -> None:
    gate = Gate(room=9)
    gate.enter([0, 1])
    assert gate.close() == 2
    assert gate.enter([2]) is False
    assert gate.enter([0, 1]) is True  # sent again, because its actor died
    assert gate.leave([2]) == 2
    assert gate.leave([0, 1]) == 0


def test_what_is_under_way_goes_on_also_when_there_is_less_room_than_before() -> None:
    gate = Gate(room=4)
    gate.enter([0, 1])
    gate.enter([2, 3])
    gate.resize(2)
    assert gate.enter([0, 1]) is True  # sent again; were all of them to wait, nothing would ever leave
