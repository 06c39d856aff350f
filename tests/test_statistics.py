import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.ensemble.statistics import Moments, MomentTree


def values(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return 1e3 + torch.randn(count, 2, 3, dtype=torch.float64, generator=generator)  # a mean far above the spread


def moments(data, cuts, order=None):
    tree = MomentTree()
    edges = [0, *cuts, len(data)]
    chunks = [(a, data[a:b]) for a, b in zip(edges, edges[1:], strict=False)]
    for i in order if order is not None else range(len(chunks)):
        tree.add(*chunks[i])
    return tree.result()


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 64, 100, 257])
def test_mean_and_error_equal_numpy(count):
    data = values(count)
    result = moments(data, [])
    assert result.count == count
    np.testing.assert_allclose(result.mean.numpy(), data.numpy().mean(0), rtol=1e-15)
    if count > 1:
        expected = data.numpy().std(0, ddof=1) / np.sqrt(count)
        # the spread is 1e-3 of the mean: its relative rounding is 1e3 that of the values
        np.testing.assert_allclose(result.stderr.numpy(), expected, rtol=1e-12)


def test_one_realization_has_an_infinite_error():
    assert torch.isinf(moments(values(1), []).stderr).all()


def test_equal_values_have_no_error():
    data = torch.full((11, 4), 0.1, dtype=torch.float64)
    result = moments(data, [3, 4])
    assert torch.equal(result.mean, data[0])
    assert not result.stderr.any()


@pytest.mark.parametrize("count", [1, 5, 16, 37, 100])
def test_chunks_and_order_change_no_bit(count):
    data = values(count, seed=count)
    whole = moments(data, [])
    random = np.random.default_rng(count)
    for _ in range(30):
        cuts = sorted(random.integers(0, count + 1, random.integers(0, 8)).tolist())
        result = moments(data, cuts, random.permutation(len(cuts) + 1))
        assert result.count == count
        assert torch.equal(result.mean, whole.mean)
        assert torch.equal(result.squares, whole.squares)
    singles = moments(data, range(1, count), random.permutation(count))
    assert torch.equal(singles.mean, whole.mean)
    assert torch.equal(singles.squares, whole.squares)


def test_a_tree_keeps_few_nodes_and_leaves_its_input_alone():
    tree, data = MomentTree(), values(1000)
    before = data.clone()
    for i in range(1000):
        tree.add(i, data[i : i + 1])
        assert len(tree.waiting) <= 10
    data += 1  # the tree must not hold views of what the caller goes on using
    assert torch.allclose(tree.result().mean, before.mean(0), rtol=1e-14)


def test_an_empty_tree_has_no_result():
    with pytest.raises(ValueError, match="no realizations"):
        MomentTree().result()


def test_merge():
    a, b = values(5), values(9, seed=1)
    merged = moments(a, []).merge(moments(b, []))
    both = torch.cat([a, b]).numpy()
    assert merged.count == 14
    np.testing.assert_allclose(merged.mean.numpy(), both.mean(0), rtol=1e-15)
    np.testing.assert_allclose(merged.stderr.numpy(), both.std(0, ddof=1) / np.sqrt(14), rtol=1e-12)


def test_moments_of_different_counts():
    one = Moments(1, torch.zeros(1), torch.zeros(1))
    three = Moments(3, torch.full((1,), 4.0), torch.full((1,), 6.0))
    merged = one.merge(three)  # 0 and three values of mean 4: mean 3, squares 6 + 16 * 3 / 4
    assert (merged.count, merged.mean.item(), merged.squares.item()) == (4, 3.0, 18.0)


def test_total_variation():
    p = torch.tensor([[0.5, 0.5, 0.0], [1.0, 0.0, 0.0]])
    q = torch.tensor([[0.5, 0.25, 0.25], [0.0, 0.0, 1.0]])
    assert tc.total_variation(p, q).tolist() == [0.25, 1.0]
    assert tc.total_variation(p, p).tolist() == [0.0, 0.0]


def test_statistical_distance_is_the_mean_distance_of_two_ensembles():
    stderr = torch.tensor([0.01, 0.03, 0.002, 0.02], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    first, second = (stderr * torch.randn(40_000, 4, dtype=torch.float64, generator=generator) for _ in range(2))
    distance = tc.total_variation(first, second)
    error = distance.std().item() / 200
    assert tc.statistical_distance(stderr).item() == pytest.approx(distance.mean().item(), abs=4 * error)
