"""Old names of arguments and attributes."""

from dataclasses import dataclass

import pytest

from khep_twin.renamed import renamed_arguments, renamed_attribute


@renamed_arguments(what="kind")
def describe(kind: str = "none") -> str:
    return kind


@dataclass(frozen=True)
class Port:
    """A class with a renamed field."""

    kind: str
    what = renamed_attribute("what", "kind")


def test_a_function_accepts_the_old_name_with_a_warning() -> None:
    assert describe(kind="robot") == describe("robot") == "robot"
    with pytest.warns(DeprecationWarning, match="'what' is an old name and will be removed; expected 'kind'"):
        assert describe(what="robot") == "robot"  # type: ignore[call-arg]


def test_a_dataclass_has_the_old_name() -> None:
    port = Port("robot")
    with pytest.warns(DeprecationWarning, match="'what'"):
        assert port.what == port.kind == "robot"


def test_both_names_of_an_argument_are_an_error() -> None:
    with (
        pytest.warns(DeprecationWarning, match="'what'"),
        pytest.raises(TypeError, match="'what' and 'kind' are one argument; expected 'kind' alone"),
    ):
        describe(what="robot", kind="twin")  # type: ignore[call-arg]
