"""The network's shape, its equations, and what sets its variants apart."""

import pytest
import torch
from torch import nn

from scenegen.model.config import VARIANTS, NetworkConfig
from scenegen.model.network import Columns, Conv3d, CrossFusion, FinalUp, Network
from tests.command_line import page

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
    assert (output.logits is None, output.tudf is None) == (variant == "tudf", variant == "occ")
    for part in output.by_target.values():
        assert part.shape == (2, *SHAPE)
    assert output.tudf is None or (output.tudf >= 0).all()


def reaches(variant, task, branch):
    """Whether the prediction of `task` depends on the weights of the decoder of `branch`."""
    net = network(variant=variant)
    output = net(seen(1))
    part = output.logits if task == "occupancy" else output.tudf
    part.sum().backward()
    return any(
        weight.grad is not None and weight.grad.abs().sum() > 0
        for weight in net.decoder[branch].parameters()
    )


def test_branches_inform_each_other_in_the_proposed_network_alone():
    for task, other in (("tudf", "occupancy"), ("occupancy", "tudf")):
        assert reaches("proposed", task, other)
        assert reaches("columns", task, "shared")


def test_crossfusion_is_equation_5():
    torch.manual_seed(0)
    fuse, t, o = CrossFusion(4), torch.rand(2, 4, 3, 2, 1), torch.rand(2, 4, 3, 2, 1)

    def add(x, y, layers):
        """x + C(x, y), a cell at a time."""
        first, _, second = layers
        both = torch.cat((x, y), dim=1).movedim(1, -1)
        hidden = torch.relu(both @ first.weight.flatten(1).T + first.bias)
        return x + (hidden @ second.weight.flatten(1).T + second.bias).movedim(-1, 1)

    new_t = add(t, o, fuse.to_tudf)
    new_o = add(o, new_t, fuse.to_occupancy)  # sees the distances already refined
    found_t, found_o = fuse(t, o)
    torch.testing.assert_close(found_t, new_t)
    torch.testing.assert_close(found_o, new_o)


def test_the_head_puts_every_value_in_its_voxel():
    head = FinalUp(1, 1).eval()
    cells = torch.rand(1, 1, 2, 3, 4)
    head.refine = nn.Identity()
    with torch.no_grad():
        head.split.weight.zero_()
        head.split.weight[:, 0, 1, 1, 1] = 1.0
        head.split.bias.copy_(torch.arange(8) * 10.0)
    found = head(cells)
    for i, j, k in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (3, 4, 5)):
        number = 4 * (i % 2) + 2 * (j % 2) + k % 2
        assert found[0, i, j, k] == cells[0, 0, i // 2, j // 2, k // 2] + 10.0 * number


def test_a_dead_channel_does_not_cap_the_logits():
    head = FinalUp(8, 8).eval()
    with torch.no_grad():
        head.refine[1].bias.fill_(-5.0)  # what a ReLU would cut off everywhere
    assert head(torch.randn(1, 8, 4, 4, 4)).std() > 0


def test_attention_looks_everywhere():
    net = network()
    cells = torch.rand(1, 32, 4, 3, 2, requires_grad=True)
    net.attention(cells)[0, :, 0, 0, 0].sum().backward()
    assert (cells.grad.abs().sum(dim=1) > 0).all()


def test_columns_and_voxels_inform_each_other_at_every_level():
    """A flat level depends on the 3-D skip of its level, both predictions on every flat level; and
    a value of a cell comes from its own height."""
    net = network(variant="columns")
    net(seen(1)).logits.sum().backward()
    for part in (*net.columns.take, *net.columns.give):
        assert part.weight.grad.abs().sum() > 0
    columns = Columns(1, 8, [(2, 4)], [3]).eval()
    give = columns.give[0]
    with torch.no_grad():
        give.weight.zero_()
        give.bias.copy_(torch.arange(8.0))
    (found,) = columns(torch.rand(1, 1, 6, 4, 8), [torch.rand(1, 2, 3, 2, 4)])
    assert found.shape == (1, 2, 3, 2, 4)
    assert torch.equal(found[0, :, 1, 1], torch.arange(8.0).reshape(2, 4))


def test_a_network_of_columns_takes_maps_of_its_height_alone():
    with pytest.raises(ValueError, match=r"sees columns of 40 voxels, no others"):
        NetworkConfig(variant="columns").check_map((80, 80, 48))


@pytest.mark.parametrize("variant", ["proposed", "columns"])
def test_completion_convolves_as_training_does(variant):
    """It asks oneDNN itself, alone or in a batch, and is given what the usual path gives."""
    net = Network(NetworkConfig(variant=variant, height=SHAPE[2])).eval()
    maps = seen(3)["observed"] < 0.1
    with torch.no_grad():
        usual = net({"observed": maps[1:2]})
    with torch.inference_mode():
        alone, together = net({"observed": maps[1:2]}), net({"observed": maps})
    torch.testing.assert_close(alone.logits, together.logits[1:2], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(alone.logits, usual.logits, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(alone.tudf, usual.tudf, atol=1e-5, rtol=1e-4)


def test_a_compiled_convolution_is_the_eager_one():
    layer, x = Conv3d(1, 2, 3, padding=1), torch.rand(1, 1, 4, 4, 4)
    with torch.inference_mode():
        torch.testing.assert_close(torch.compile(layer, backend="eager")(x), layer(x))


def test_the_docs_name_every_variant_as_it_is():
    text = page("network.md")
    for name, one in VARIANTS.items():
        decoders, tasks = (", ".join(names) or "none" for names in (one.decoders, one.tasks))
        assert f"| `{name}` | {decoders} | {tasks} | " in text
