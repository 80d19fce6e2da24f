"""Only the user can have the module of a dataset's kind imported."""

import pytest

from scenegen.errors import PublishError
from scenegen.publish.regenerate import check_kind


@pytest.mark.parametrize(("there", "named"), [("pillar", None), ("scene", None), ("a:B", "a:B")])
def test_kinds_of_scenegen_and_those_that_the_user_names_pass(there: str, named: str | None) -> None:
    check_kind(there, named)


@pytest.mark.parametrize(("there", "named"), [("a:B", None), ("a:B", "a:C"), ("nobodys", None), ("a:B", "pillar")])
def test_others_are_refused(there: str, named: str | None) -> None:
    with pytest.raises(PublishError, match="give --kind with its name"):
        check_kind(there, named)
