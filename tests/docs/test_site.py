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


def test_the_site_holds_the_page_that_it_shows(site):
    shown = (site / "pictures" / "look" / "live.html").read_text()
    assert shown.count('"name": "world ') == 3
    assert "live.html" in (site / "assets" / "site.js").read_text()
