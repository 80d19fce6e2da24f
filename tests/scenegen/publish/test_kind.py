"""What makes a dataset again: the command, and the kind, whose module only the user can have
imported."""

import dataclasses

import pytest

from scenegen.publish.stage import examine
from tests.scenegen import refuses
from tests.scenegen.verification.forge import edit_at


@pytest.mark.parametrize("named", [None, "a:C", "pillar"])
def test_a_kind_of_somebody_elses_has_to_be_named(asked, dataset, named):
    edit_at(dataset, "recipe.kind", '"a:B"')
    refuses("--kind", lambda: examine(dataclasses.replace(asked, kind=named)))
