"""The error tree and its messages."""

from __future__ import annotations

import pytest

from a4agent import errors


def test_the_tree_in_the_docstring_is_the_tree() -> None:
    drawn = {line.split("── ")[1].split()[0] for line in (errors.__doc__ or "").splitlines() if "── " in line}
    defined = {n for n, c in vars(errors).items() if isinstance(c, type) and issubclass(c, errors.A4Error)}
    assert drawn == defined - {"A4Error"}


def test_what_can_succeed_later_is_never_fatal() -> None:
    for value in vars(errors).values():
        if isinstance(value, type) and issubclass(value, errors.A4Error):
            assert not (value.retryable and value.fatal)


def test_an_unknown_name_suggests_the_nearest_or_lists_all() -> None:
    assert "did you mean 'sam2'" in str(errors.UnknownNameError.of("provider", "sam22", ["sam2", "openai"]))
    assert "known: openai, sam2." in str(errors.UnknownNameError.of("provider", "zzzz", ["sam2", "openai"]))


def test_a_missing_library_names_the_pip_command() -> None:
    with pytest.raises(errors.MissingExtraError, match=r"pip install 'a4agent\[local\]'"):
        errors.require("no_such_library_here.sub", extra="local")
    assert errors.require("json", extra="local").loads("1") == 1
