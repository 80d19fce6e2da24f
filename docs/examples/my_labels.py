"""The class of every voxel as a third head of any network, with metrics of its own."""

import numpy as np
import torch
from torch.nn.functional import cross_entropy

from scenegen.model.bench.metrics import Metric
from scenegen.model.targets import Target


def classes_of(scored_map):
    """The predicted and the true class of every scored voxel; None twice without a prediction."""
    predicted = scored_map.prediction.others.get("classes")
    if predicted is None:  # another row of the bench
        return None, None
    return predicted[scored_map.scored], scored_map.truth["classes"][scored_map.scored]


def accuracy(scored_map):
    """Share of voxels with the right class; NaN counts as not measured."""
    predicted, truth = classes_of(scored_map)
    return float("nan") if predicted is None else (predicted == truth).mean()


def mean_iou(scored_map):
    """IoU of each class that is in the map or predicted, and of these the mean."""
    predicted, truth = classes_of(scored_map)
    if predicted is None:
        return float("nan")
    pairs = [(predicted == c, truth == c) for c in np.union1d(predicted, truth)]
    return np.mean([(mine & true).sum() / (mine | true).sum() for mine, true in pairs])


class Classes(Target):
    """The class of every voxel, of a dataset made with --labels."""

    metrics = {
        "accuracy": Metric("class accuracy", accuracy),
        "miou": Metric("mIoU of classes", mean_iou),
    }

    def channels(self, parts):
        return parts["labels"].classes

    def truth(self, sample, grid):
        return sample.voxel_class.astype(np.int64)

    def loss(self, output, batch, objective):
        return 0.2 * cross_entropy(output.float(), batch["classes"])

    def prediction(self, output, grid):
        return output.argmax(dim=1).to(torch.uint8)
