"""docs/verify.md says of every check what the check says of itself."""

from pathlib import Path

from scenegen.verification.checks import CHECKS

PAGE = Path(__file__).parents[3] / "docs" / "verify.md"


def test_the_table_is_that_of_the_checks() -> None:
    rows = [
        f"| `{check.name}` | {'yes' if check.quick else ''} | {check.proves} |" for check in CHECKS
    ]
    table = "\n".join(["| check | `--quick` | proves |", "|---|---|---|", *rows])
    assert f"\n\n{table}\n\n" in PAGE.read_text(encoding="utf-8")


def test_every_check_has_a_name_of_its_own_and_proves_something_in_one_sentence() -> None:
    assert len({check.name for check in CHECKS}) == len(CHECKS) == 19
    for check in CHECKS:
        assert check.proves[0].isupper() or check.proves[0] == "`"
        assert check.proves.endswith(".")
        assert ". " not in check.proves
        assert check.proves.isprintable()
