"""The network's shape, its equations, and what sets its variants apart."""

import pytest
import torch

from scenegen.model.config import VARIANTS, NetworkConfig
from scenegen.model.network import Conv3d, Network
from tests.command_line import page
from tests.refusals import refuses
from tests.scenegen import each_case

SHAPE = (16, 24, 8)


def network(**config):
    torch.manual_seed(0)
    return Network(NetworkConfig(height=SHAPE[2], **config)).eval()


def seen(batch):
    """A batch of maps of noise."""
    return {"observed": torch.rand(batch, *SHAPE)}


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_predicts_its_tasks_at_full_size(variant):
    output = network(variant=variant)(seen(2))
    assert (output.logits is None) == (variant == "tudf")
    assert (output.tudf is None) == (variant == "occ")
    for part in output.by_target.values():
        assert part.shape == (2, *SHAPE)
    assert output.tudf is None or (output.tudf >= 0).all()


@each_case("../model/branches", "variant task branch")
def test_predictions_depend_on_other_branches(variant, task, branch):
    net = network(variant=variant)
    getattr(net(seen(1)), task).sum().backward()
    gradients = [weight.grad for weight in net.decoder[branch].parameters()]
    assert any(gradient is not None and gradient.any() for gradient in gradients)


def test_a_network_of_columns_takes_maps_of_its_height_alone():
    refuses("height", NetworkConfig(variant="columns").check_map, (80, 80, 48))


@pytest.mark.parametrize("variant", ["proposed", "columns"])
def test_completion_convolves_as_training_does(variant):
    """It asks oneDNN itself, alone or in a batch, and is given what the usual path gives."""
    net, maps = network(variant=variant), seen(3)["observed"] < 0.1
    with torch.no_grad():
        usual = net({"observed": maps[1:2]}).by_target
    with torch.inference_mode():
        alone = net({"observed": maps[1:2]}).by_target
        together = net({"observed": maps}).by_target
    for name, expected in usual.items():
        torch.testing.assert_close(alone[name], together[name][1:2], atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(alone[name], expected, atol=1e-4, rtol=1e-4)


def test_a_compiled_convolution_is_the_eager_one():
    layer, x = Conv3d(1, 2, 3, padding=1), torch.rand(1, 1, 4, 4, 4)
    with torch.inference_mode():
        torch.testing.assert_close(torch.compile(layer, backend="eager")(x), layer(x))


def test_the_docs_name_every_variant_as_it_is():
    text = page("network.md")
    for name, one in VARIANTS.items():
        decoders, tasks = (", ".join(names) or "none" for names in (one.decoders, one.tasks))
        assert f"| `{name}` | {decoders} | {tasks} | " in text
