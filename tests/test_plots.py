"""Figures: what is drawn is what was measured, on axes of the caller's or of their own."""

from itertools import combinations

import numpy as np
import pytest
import torch
from matplotlib.collections import FillBetweenPolyCollection

import torchchain as tc
from torchchain import plots
from torchchain.cli.calibration_figure import calibration_figure, rates_of, sources_of

WAVE = tc.Scene(
    n_particles=32, boundary="fixed", excitation=tc.Impulse(), observables=("center", "width", "energy"),
    realizations=6, times=[0.0, 1.0, 2.0, 4.0, 8.0],
)  # fmt: skip


@pytest.fixture(scope="module")
def moments():
    return tc.simulate(WAVE, method="modes")


@pytest.mark.parametrize("log", [False, True])
def test_observables_over_time(moments, log):
    for name, symbol in (("center", "$R$"), ("width", "$r^2$")):
        ax = tc.plot_observable(moments, name, log=log)
        first = int(log)
        np.testing.assert_array_equal(ax.lines[0].get_xdata(), moments["time"].values[first:])
        np.testing.assert_array_equal(ax.lines[0].get_ydata(), moments[name].values[first:])
        assert (ax.get_xscale(), ax.get_yscale()) == (("log", "log") if log else ("linear", "linear"))
        assert symbol in ax.get_ylabel()
        (band,) = (found for found in ax.collections if isinstance(found, FillBetweenPolyCollection))
        low = (moments[name] - moments[f"{name}_stderr"]).values[first:]
        assert band.get_paths()[0].vertices[:, 1].min() == pytest.approx(low.min(), rel=1e-12)


def test_what_cannot_be_drawn_over_time(moments):
    with pytest.raises(tc.FieldError, match="name must be one of center, width, energy"):
        tc.plot_observable(moments, "radius")
    with pytest.raises(tc.FieldError, match="axis time alone"):
        tc.plot_observable(moments, "energy")


def test_transfer_and_rates(small_transfer, tmp_path):
    ax = small_transfer.plot(source=2, receivers=(2, 4))
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["2 to 2", "2 to 4"]
    np.testing.assert_array_equal(ax.lines[1].get_ydata(), small_transfer.mean[1, :, 3])
    assert small_transfer.plot(source=1, ax=ax) is ax
    assert [text.get_text() for text in small_transfer.plot(1).get_legend().get_texts()] == ["1 to 1", "1 to 2"]
    whole = small_transfer.plot_map().collections[0]
    np.testing.assert_allclose(whole.get_array().reshape(4, 4), small_transfer.long_time.clamp(min=1e-3), rtol=1e-15)
    one = small_transfer.plot_map(source=3)
    np.testing.assert_allclose(one.collections[0].get_array(), small_transfer.mean[2].T.clamp(min=1e-3), rtol=1e-15)
    one.figure.savefig(tmp_path / "map.pdf")
    assert (tmp_path / "map.pdf").read_bytes().startswith(b"%PDF")
    master = tc.calibrate(small_transfer, model="paper", method="linear", bootstrap=0)
    drawn = master.plot_rates().collections[0].get_array().reshape(4, 4)
    np.testing.assert_allclose(drawn.diagonal(), -master.rates.detach().diagonal(), rtol=1e-15)
    for source in (0, 5, 2.5):
        with pytest.raises((tc.FieldError, tc.FieldTypeError), match="source"):
            small_transfer.plot(source)


@pytest.mark.parametrize("shown", [(2,), (1, 4)])
def test_labels_of_a_calibration_have_room(small_transfer, shown):
    master = tc.calibrate(small_transfer, bootstrap=0)
    predicted = master.solve(torch.eye(4, dtype=torch.float64), small_transfer.times).detach()
    figure = calibration_figure(small_transfer, master, predicted, rates_of(small_transfer, master), shown)
    figure.draw_without_rendering()
    boxes = [ax.get_tightbbox() for ax in figure.axes]
    assert len(boxes) == 3 * len(shown) + 3 + 2 * len(shown) + 1
    for box in boxes:
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert box.x1 <= figure.bbox.x1
        assert box.y1 <= figure.bbox.y1
    assert not [(i, j) for i, j in combinations(range(len(boxes)), 2) if boxes[i].overlaps(boxes[j])]


def test_style_is_of_the_figure_alone():
    import matplotlib

    before = dict(matplotlib.rcParams)
    plots.own_axes()
    assert dict(matplotlib.rcParams) == before


def test_letters_once_and_none_where_nothing_is_drawn():
    figure, axes = plots.figure(4, 4, 2, 2)
    axes[0, 1].set_axis_off()
    axes[1, 0].set_title("rates", loc="left")
    plots.lettered(axes.flat)
    assert [ax.get_title("left") for ax in axes.flat] == ["(a)", "", "(b) rates", "(c)"]
    assert figure is axes[0, 0].figure


@pytest.mark.parametrize(
    ("asked", "found"), [(None, (10, 23)), ("12,15", (12, 15)), ("12, 12", (12,)), ("1 2 3", (1, 2, 3))]
)
def test_sources_to_show(asked, found):
    assert sources_of(asked, 32) == found


@pytest.mark.parametrize("asked", ["", "0", "33", "a", "1,,b", "1.5", "1,2,3,4,5,6,7", "-1"])
def test_sources_that_cannot_be_shown(asked):
    with pytest.raises(tc.FieldError, match="show must"):
        sources_of(asked, 32)
