"""The page served: samples as they are, to who asks it by its own address, and lines about what is
damaged."""

import http.client
import json
import socket
import threading
from contextlib import contextmanager

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from lidarsim import attach
from scenegen import SPLITS
from scenegen.base.errors import ScenegenError
from scenegen.dataset.read import Dataset
from scenegen.view import live
from scenegen.view.glb import surfaces
from scenegen.view.live import view_live
from scenegen.view.look import Guess, look_into
from scenegen.view.page import Live, packed
from tests.refusals import refuses_command
from tests.scenegen.verification.forge import edit_manifest
from tests.scenegen.view.test_page import HOSTILE, Seen, array


@contextmanager
def served(*folders, **options):
    datasets = [Dataset(folder, partial=True) for folder in folders]
    server = Live(datasets, **{"split": "train", **options})
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def ask(server, path, *, method="GET", **headers):
    """Status, headers and content of an answer."""
    link = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=10)
    try:
        link.request(method, path, headers=headers)
        answer = link.getresponse()
        return answer.status, answer.headers, answer.read().decode()
    finally:
        link.close()


def error_of(server, path):
    """The line in which a request ends that cannot be answered."""
    status, _, text = ask(server, path)
    assert status == 404
    return json.loads(text)["error"]


def guessed(samples, index):
    sample = samples[index]
    return [Guess(name=HOSTILE, occupied=sample.observed, tudf=sample.tudf)]


def test_samples_are_served_as_they_are_by_split_and_number(made):
    dataset = Dataset(made)
    with served(made, split="test", index=2, guesses=guessed, methods=(HOSTILE,)) as server:
        status, headers, text = ask(server, "/")
        assert (status, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
        assert "<script>alert" not in text
        page = Seen(text)
        splits = {name: len(dataset.split(name)) for name in SPLITS if len(dataset.split(name))}
        datasets = [{"name": "pillar", "splits": splits}]
        assert page.data()["live"] == {"datasets": datasets, "split": "test", "index": 2}
        assert page.policy().startswith("default-src 'none'")
        assert page.policy().endswith("; connect-src 'self'")
        for split, number in (("train", 7), ("test", 0)):
            status, headers, text = ask(server, f"/sample/0/{split}/{number}")
            assert (status, headers["X-Content-Type-Options"]) == (200, "nosniff")
            expected = packed(look_into(dataset.split(split), number, guessed))
            assert json.loads(text) == json.loads(json.dumps(expected)) | {"notes": []}
        strange = "0/train/11", "0/none/0", "0/train/-1", "1/train/0", "../../etc/passwd"
        assert {ask(server, f"/sample/{path}")[0] for path in strange} == {404}
        assert ask(server, "/", method="POST")[0] == 501


def test_the_world_of_a_sample_is_served_in_its_maps_frame(made):
    dataset = Dataset(made)
    sample = dataset.split("test")[2]
    with served(made, split="test") as server:
        triangles = json.loads(ask(server, "/world/0/test/2")[2])["triangles"]
        assert error_of(server, "/world/1/test/0").startswith("no such dataset")
        assert error_of(server, "/world/0/test/999").startswith("the world is not shown: ")
    corners = array(triangles, "<f4").reshape(-1, 3)
    world = dataset.compile("test", int(sample.world))
    expected = np.concatenate([solid.triangles.reshape(-1, 3) for solid in surfaces(world)])
    assert_allclose(corners + sample.origin, expected, atol=1e-5)


def test_a_strangers_name_is_refused(made):
    with served(made) as server:
        port = server.server_address[1]
        own = (f"127.0.0.1:{port}", f"localhost:{port}", "localhost:9000", "[::1]:9000")  # by SSH
        strange = ("evil.example", f"evil.example:{port}", "127.0.0.1.evil.example", "", "[::1")
        for host in (*own, *strange, socket.gethostname()):  # it is served on the loopback alone
            status, _, text = ask(server, "/sample/0/train/0", Host=host)
            expected = (200, True) if host in own else (403, False)
            assert (status, "points" in text) == expected, host


def test_an_address_that_cannot_be_had_is_an_error(made):
    with served(made) as server:
        port = server.server_address[1]
        with pytest.raises(ScenegenError, match=f"{port}: .* another --port"):
            Live([Dataset(made)], split="train", port=port)


@pytest.mark.parametrize("words", ["--host example.com", "--index 99 --port 0"])
def test_what_cannot_be_served_ends_in_one_line(made, capsys, words):
    refuses_command(capsys, f"view {made} {words}", words)


def taken(server):
    """The header, the places of geoms and the points, metres, of the scan that is served."""
    _, _, content = server.reply("/scan/0")
    begin = 4 + int.from_bytes(content[:4], "little")
    head = json.loads(content[4:begin])
    end = len(content) - 8 * head["points"]
    places = np.frombuffer(content[begin:end], "<f4").reshape(-1, 12)
    numbers = np.frombuffer(content[end:], "<i2").reshape(-1, 4)[:, :3]
    return head, places, numbers / 32767 * head["reach"] + head["sensors"][0][:3]


@pytest.fixture
def running():
    """A simulation of a robot beside a box, and its sensor."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="0 0 1"/><geom size="1 1 1" type="box"
        pos="4 0 1"/><body name="robot" mocap="true" pos="0 0 1"><geom size=".2"/></body>
        </worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return attach(model, "robot"), data


def test_the_newest_scan_of_a_simulation_is_served(running):
    sensor, data = running
    with view_live(sensor, browser=False) as viewer:
        viewer.update(data)
        data.mocap_pos[0] = 1.0, 0.0, 1.0
        mujoco.mj_kinematics(sensor.model, data)
        (scan,) = viewer.update(data)
        head, places, points = taken(viewer)
        assert (head["number"], head["points"]) == (2, len(scan.points()))
        assert_allclose(points, scan.points(), atol=head["reach"] / 65534 + 1e-9)
        assert_allclose(places[2, :3], (1.0, 0.0, 1.0))
        assert json.loads(viewer.reply("/solids")[2])["geoms"] == [0, 1, 2]
        assert viewer.reply("/scan/../x") is None


def test_a_page_without_a_newer_scan_gets_nothing(running, monkeypatch):
    monkeypatch.setattr(live, "WAIT_S", 0.01)
    with view_live(running[0], browser=False) as viewer:
        assert viewer.reply("/scan/0")[2] == b""


def test_what_is_damaged_is_reported_and_other_samples_are_served(dataset):
    (dataset / "train-00001.h5").unlink()  # samples 3 to 5
    edit_manifest(dataset, complete=False, digest=None)
    with served(dataset) as server:
        assert "train-00001.h5" in error_of(server, "/sample/0/train/4")
        assert "incomplete" in json.loads(ask(server, "/sample/0/train/6")[2])["notes"][0]
