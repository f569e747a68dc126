from __future__ import annotations

import pytest

from a4agent.serve.limits import Refused


@pytest.mark.parametrize(("seconds", "header"), [(0.0, "1"), (0.2, "1"), (1.6, "2"), (60.0, "60")])
def test_retry_after_is_whole_seconds_and_never_at_once(seconds: float, header: str) -> None:
    assert Refused(503, "busy", seconds).headers == {"Retry-After": header}


def test_a_refusal_for_good_names_no_time() -> None:
    refused = Refused(413, "too large")
    assert refused.headers == {}
    assert refused.body == {"error": "too large"}
