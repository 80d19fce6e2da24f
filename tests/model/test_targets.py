"""A target of a user's own: the classes of voxels, as a third head, trained, stored and read
back."""

import dataclasses
import json
import re
import shutil
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import scenegen
from scenegen import Completer
from scenegen.model.bench.methods import Predicted
from scenegen.model.completion.predictions import predict_split
from scenegen.model.completion.stored import prediction_facts
from scenegen.model.config import NetworkConfig, TrainConfig
from scenegen.model.targets import target_called
from scenegen.worlds.labels import labels_by
from tests.command_line import ROOT, done, example, page
from tests.conftest import dataset_in, small_recipe
from tests.model.training.runs import figures, train
from tests.refusals import refuses, refuses_command
from tests.scenegen import each_case

COUNTS = {"train": 8, "val": 4, "test": 4}
PREDICTED = "bench data/street --method empty --predictions predictions --metric my_labels:Classes"
LABELS = labels_by("name", ())
pytestmark = pytest.mark.usefixtures("undrawn")


def labelled_in(folder):
    recipe = dataclasses.replace(small_recipe(), parts={"labels": LABELS})
    dataset_in(folder / "d", recipe, counts=COUNTS)


@pytest.fixture
def here(once, standing):
    """A user's folder with the page's target, to stand in."""
    (standing / "data").mkdir()
    (standing / "data" / "street").symlink_to(once("labelled", labelled_in) / "d")
    shutil.copy(ROOT / "docs/examples/my_labels.py", standing)
    yield standing
    target_called.cache_clear()


def config_of(**more):
    target = {"targets": ("my_labels:Classes",), "width": 4, "batch": 4, "epochs": 2}
    return TrainConfig.of({**target, "precision": "float32", **more})


@pytest.fixture
def trained(here):
    """The same, with a short run."""
    train(["data/street"], config_of(epochs=1), here / "run")
    return here


def test_the_page_trains_completes_and_reads_back(here, capsys):
    lines = re.findall(r"^    scenegen (.*)$", page("own-network.md"), re.MULTILINE)
    training, completing, benching = lines[1:4]
    done(capsys, f"{training} --epochs 6 --width 4 --batch 4 --device cpu --lr 0.01")
    losses = [float(row["val_classes"]) for row in figures(Path("runs/classes"))]
    assert losses[-1] < 0.8 * losses[0]
    done(capsys, completing)
    exec(example("own-network.md", "import h5py"), {})
    samples = scenegen.load("data/street", "test")
    completer = Completer.from_pretrained("my_labels:Classes@runs/classes")
    read = Predicted(Path("predictions"))
    read.check(samples.dataset, "test")
    for sample in samples:
        classes = read.completion(sample, samples).others["classes"]
        assert_array_equal(classes, completer(sample).others["classes"])
        assert classes.dtype == np.uint8
        assert classes.max() < len(LABELS.classes)
        assert (classes == sample.voxel_class).mean() > 0.5
    assert prediction_facts(Path("predictions/test-00000.h5"))["arrays"]["classes"][0] == 4
    assert "classes" in Path("runs/classes/card.md").read_text()
    # the network's own row, and the file's, whose targets are named
    done(capsys, f"{benching} --quick --quiet --workers 1 --method empty")
    done(capsys, f"{PREDICTED} --quiet -o again --workers 1")
    held = [json.loads(Path(at, "report.json").read_text()) for at in ("bench", "again")]
    by_net, by_file = (report["reconstruction"]["pillar"] for report in held)
    said = [read.completion(sample, samples).others["classes"] for sample in samples]
    right = (np.array(said) == [sample.voxel_class for sample in samples]).mean()
    assert by_net["classes"]["classes_accuracy"]["mean"] == pytest.approx(right, abs=1e-6)
    assert by_net["classes"]["classes_miou"] == by_file["predictions"]["classes_miou"]
    assert by_net["empty"]["classes_miou"]["n"] == 0
    assert "mIoU of classes" in Path("bench/report.md").read_text()


def test_metrics_of_classes_need_their_truth(here, folders, capsys):
    (row,) = train(["data/street"], config_of(epochs=1), here / "run")
    assert 0 <= row["val_classes_miou"] <= row["val_classes_accuracy"] <= 1
    words = f"bench {folders[0]} --quick --quiet --workers 1 --weights my_labels:Classes@run"
    done(capsys, f"{words} --method empty")
    assert "classes_miou" not in Path("bench/report.json").read_text()
    assert "metrics of classes are left out" in Path("bench/report.md").read_text()
    refuses_command(capsys, f"{words} --metric my_labels:Classes")


def test_a_fault_of_the_truth_is_not_taken_for_a_missing_one(trained, capsys):
    with Path("my_labels.py").open("a") as file:
        file.write("    def truth(self, sample, grid):\n        return sample.voxel_class / None\n")
    target_called.cache_clear()
    sys.modules.pop("my_labels", None)
    words = "bench data/street --quick --quiet --workers 1 --weights my_labels:Classes@run"
    refuses_command(capsys, words)


def test_a_scan_is_stored_with_its_classes(trained, capsys):
    completer = Completer.from_pretrained("my_labels:Classes@run")
    sample = scenegen.load("data/street", "test")[0]
    points = sample.points()
    np.savez("scan.npz", points=points)
    sensor = sample.position.tolist()
    words = "complete scan.npz --weights my_labels:Classes@run -o scan.h5 --sensor"
    done(capsys, f"{words} {' '.join(map(str, sensor))}")
    with h5py.File("scan.h5") as file:
        assert_array_equal(file["classes"], completer(points, sensor=sensor).others["classes"])


@pytest.mark.parametrize("variant", ["occ", "columns"])
def test_a_head_changes_none_of_the_others_shapes(here, variant):
    train(["data/street"], config_of(variant=variant, epochs=1), here / "run")
    completer = Completer.from_pretrained("my_labels:Classes@run")
    prediction = completer(np.zeros((3, 24, 24, 16), bool))
    assert prediction.others["classes"].shape == prediction.occupancy_probability.shape
    assert (prediction.tudf is None) == (variant == "occ")


def test_files_that_name_other_arrays_are_refused(trained):
    dataset = scenegen.load("data/street", "test").dataset
    predict_split(
        Completer.from_pretrained("my_labels:Classes@run"), dataset, "test", trained / "p"
    )
    Predicted(trained / "p").check(dataset, "test")
    for others in ("world", "classes,classes", "a b", "absent", "tudf", "x/y"):
        with h5py.File(trained / "p" / "test-00000.h5", "a") as file:
            file.attrs["others"] = others
            file.attrs.pop("digest", None)
        refuses(others, Predicted(trained / "p").check, dataset, "test")


def test_a_file_has_no_target_imported_by_itself(trained, capsys):
    refuses_command(capsys, "complete data/street --weights run")


WRONG = """
import numpy as np
from my_labels import Classes
class Plain: pass
class Short(Classes):
    def truth(self, sample, grid): return sample.voxel_class[:-1].astype(np.int64)
class Missing(Classes):
    def channels(self, parts): return parts["colours"].classes
class Shapeless(Classes):
    def prediction(self, output, grid): return output[..., 0]
class Iou(Classes):
    def loss(self, output, batch, objective): return output.mean()
class Unweighted(Classes):
    def loss(self, output, batch, objective): return 3.0
class Mean(Classes):
    def loss(self, output, batch, objective): return output.float().mean()
class Best(Mean): metrics = {"iou": lambda scored: 1.0}
class Near(Mean): metrics = {"rmse": lambda scored: 1.0}
class Numeric(Mean): metrics = {"one": 1.0}
class Normal(Mean):
    def truth(self, sample, grid): return sample.return_normal[..., 0]
class Failing(Mean): metrics = {"one": lambda scored: scored.truth["absent"]}
class Wordy(Mean): metrics = {"one": lambda scored: "high"}
class Lossless(Classes): loss = lambda *given: None
class Channelless(Mean): channels = 0
class Nameless(Mean): channels = lambda *given: None
class Void(Mean): prediction = lambda *given: None
class Cut(Mean): turned = lambda self, truth, symmetry: truth[:3]
class Listed(Mean): metrics = [1]
"""


@each_case("../model/targets", "name")
def test_what_is_wrong_with_a_target_is_told_in_one_line(here, name):
    (here / "wrong.py").write_text(WRONG)
    refuses(name, train, ["data/street"], config_of(targets=(f"wrong:{name}",)), here / "run")
    assert not (here / "run").exists()


@each_case("../model/target_settings", "settings")
def test_names_of_other_maps_are_refused(settings):
    refuses(settings, NetworkConfig, **json.loads(settings))


OWN = """
import torch
from torch import nn
from scenegen import Output
class Net(nn.Module):
    tasks = ("occupancy",)
    def __init__(self, config):
        super().__init__()
        self.body = nn.Conv3d(1, 1 + config.channels_of("classes"), 3, padding=1)
    def forward(self, batch):
        logits, *classes = self.body(batch["observed"].float()[:, None]).unbind(dim=1)
        return Output(logits, None, {"classes": torch.stack(classes, dim=1)})
class Silent(Net):
    def forward(self, batch):
        return super().forward(batch)._replace(others={})
"""


def test_a_network_of_ones_own_predicts_it_and_is_exported(here, capsys):
    (here / "own.py").write_text(OWN)
    own = "own:Net,my_labels:Classes@run"
    train(["data/street"], config_of(variant="own:Net"), here / "run")
    done(capsys, f"export {own} -o net.onnx")
    maps = np.random.default_rng(0).random((3, 24, 24, 16)) < 0.1
    network = Completer.from_pretrained(own)
    exported = Completer.from_pretrained("my_labels:Classes@net.onnx")
    classes = network(maps).others["classes"]
    assert (exported(maps).others["classes"] == classes).mean() > 0.99
    refuses("by itself", Completer.from_pretrained, "net.onnx")
    silent = config_of(variant="own:Silent")
    refuses("silent", train, ["data/street"], silent, here / "silent")


def test_a_second_task_is_a_target_like_any(here):
    """The paper's two tasks, as two decoders that are not coupled."""
    config = config_of(variant="occ", targets=("tudf",), epochs=1)
    rows = train(["data/street"], config, here / "run")
    assert {"val_occupancy", "val_regression", "val_eikonal"} <= rows[0].keys()
    assert Completer.from_pretrained("run")(np.zeros((24, 24, 16), bool)).tudf.min() >= 0
