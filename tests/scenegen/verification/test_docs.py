"""docs/verify.md lists every check, and says how to write one's own."""

import re

from scenegen.verification import verify
from scenegen.verification.folder import CHECKS
from tests.command_line import done, example, page
from tests.refusals import refuses


def test_the_table_has_the_checks_in_order():
    rows = re.findall(r"^\| `([a-z -]+)` \| (yes)? *\| ", page("verify.md"), re.MULTILINE)
    assert rows == [(check.name, "yes" if check.quick else "") for check in CHECKS]


OWN = """
low = Check(name="low", proves="x", sample=lambda s, page: page.fault(s.where))
bad = Check(name="bad", proves="x", sample=lambda s, page: 1 / 0)
"""


def test_a_check_of_ones_own(folder, standing, capsys):
    (standing / "my_checks.py").write_text(example("verify.md", "high = Check") + OWN)
    own = [f"my_checks:{name}" for name in ("high", "low", "bad")]
    checks = verify(folder, quick=True, own=own).checks[-3:]
    assert [(check.name, check.faults) for check in checks] == [
        ("high", 0),
        ("low", 12),
        ("bad", 12),
    ]
    assert checks[0].counts == {"samples": 12}
    assert "of my_checks.py: ZeroDivisionError: division by zero" in checks[2].detail
    done(capsys, f"verify {folder} --quick --check my_checks:high")
    refuses("none", verify, folder, own=["my_checks:none"])
