"""The site of the docs is built without a warning, and its reference holds what people import."""

import os

import pytest

import lidarsim
import scenegen
from tests.command_line import ROOT, python

pytestmark = [pytest.mark.checkout, pytest.mark.slow]

pytest.importorskip("mkdocs")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    python("-m", "mkdocs", "build", "--strict", "--site-dir", folder, cwd=ROOT, env=quiet)
    return folder


@pytest.mark.parametrize("package", [lidarsim, scenegen])
def test_the_reference_has_every_public_name(site, package):
    name = package.__name__
    page = (site / "api" / name / "index.html").read_text()
    public = package.__all__
    missing = [
        one for one in public if not one.startswith("_") and f'id="{name}.{one}"' not in page
    ]
    assert missing == []


def test_the_record_of_work_is_not_on_the_site(site):
    assert (site / "glossary" / "index.html").exists()
    assert not (site / "log").exists()


@pytest.mark.parametrize("name", ["page", "movers"])
def test_the_site_holds_the_pages_that_it_shows(site, name):
    shown = (site / "pictures" / "look" / f"{name}.html").read_text()
    assert shown.count('"name": "world ') == 3
    assert ('"movers": {' in shown) == (name == "movers")
    assert f"look/{name}.webp" in (site / "assets" / "site.js").read_text()
