"""Results cannot be changed, go through pickles and copies, and give plain dictionaries."""

import copy
import dataclasses
import json
import pickle

import numpy as np
import pytest

from wpdc_gwcs import Calibration, DistortionSolution, LookupTable, PVPolynomial
from wpdc_gwcs.camera import Camera
from wpdc_gwcs.frozen import FrozenDict, freeze, frozen_array

NESTED = {"a": [1, {"b": [2.5]}], "c": np.arange(3.0), "d": None}


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d.__setitem__("a", 1),
        lambda d: d.__delitem__("a"),
        lambda d: d.update(a=1),
        lambda d: d.setdefault("x", 1),
        lambda d: d.pop("a"),
        lambda d: d.popitem(),
        lambda d: d.clear(),
        lambda d: d.__ior__({"x": 1}),
        lambda d: d["a"][1].update(b=1),
        lambda d: d["a"].__setitem__(0, 1),
    ],
)
def test_nothing_changes_it(change):
    frozen = freeze(NESTED)
    with pytest.raises((TypeError, AttributeError)):
        change(frozen)
    assert list(frozen) == list(NESTED)


def test_arrays_are_its_own():
    values = np.arange(3.0)
    frozen = freeze({"values": values})
    values[0] = 7.0
    assert frozen["values"][0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        frozen["values"][0] = 1.0
    owner = dataclasses.make_dataclass("Owner", ["cd"])(values)
    assert frozen_array(owner, "cd", shape=(None,)) is owner.cd is not values


@pytest.mark.parametrize("way", [copy.copy, copy.deepcopy, lambda d: pickle.loads(pickle.dumps(d))])
def test_it_stays_frozen_on_its_way(way):
    frozen = freeze({"a": {"b": [1, 2]}})
    again = way(frozen)
    assert again == frozen
    assert type(again) is type(again["a"]) is FrozenDict


def test_nodes_of_a_table_are_read_only():
    table = LookupTable(np.arange(4.0), np.arange(4.0), *np.zeros((2, 4, 4)))
    for nodes in (table.x_grid, table.y_grid, table.dx, table.dy):
        with pytest.raises(ValueError, match="read-only"):
            nodes[0] = 1.0
    # A model of astropy has parameters that can be set, as one.
    table.displacement = np.ones((2, 4, 4))
    assert table(1.0, 1.0) == (1.0, 1.0)


def a_calibration():
    grid = np.linspace(-0.5, 9.5, 4)
    table = LookupTable(grid, grid, *np.ones((2, 4, 4)))
    solution = DistortionSolution(
        "a", (10, 10), [5, 5], 1e-4 * np.eye(2), [1, 2], PVPolynomial(), lookup_table=table
    )
    return Calibration("f", solution, crval=[1, 2], cd=1e-4 * np.eye(2), field=table)


@pytest.mark.parametrize(
    "way",
    [
        lambda c: c, copy.copy, copy.deepcopy, dataclasses.replace,
        lambda c: pickle.loads(pickle.dumps(c)),
    ],
)  # fmt: skip
@pytest.mark.parametrize(
    "change",
    [
        lambda c: setattr(c.solution.pv, "pv1_0", 1.0),
        lambda c: setattr(c.solution.pv.pv2_7, "value", 1.0),
        lambda c: setattr(c.solution.pv, "parameters", np.zeros(20)),
        lambda c: setattr(c.solution.lookup_table, "displacement", np.zeros((2, 4, 4))),
        lambda c: setattr(c.field, "displacement", np.zeros((2, 4, 4))),
    ],
)
def test_models_of_results_cannot_be_changed(way, change):
    calibration = way(a_calibration())
    before = calibration.wcs(3.0, 4.0)
    with pytest.raises(TypeError, match="belongs to a result, which cannot be changed"):
        change(calibration)
    assert calibration.wcs(3.0, 4.0) == before


def test_models_are_the_results_own():
    calibration, given = a_calibration(), PVPolynomial()
    solution = dataclasses.replace(calibration.solution, pv=given)
    given.pv1_0 = 5.0
    assert solution.pv.pv1_0 == 0.0
    # Those of others can be changed, and copies, as a fitter makes them.
    for model in (solution.pv.copy(), copy.deepcopy(solution.pv)):
        model.pv1_0 = 5.0
        assert model(0.0, 0.0)[0] == 5.0
    assert solution.pv(0.0, 0.0)[0] == 0.0


def test_it_is_a_dictionary():
    frozen = freeze({"a": {"b": [1, 2]}})
    assert json.loads(json.dumps(frozen)) == {"a": {"b": [1, 2]}}
    for plain in (dict(frozen), {**frozen}, frozen | {}, frozen.copy()):
        plain["c"] = 1
        assert "c" not in frozen
    assert freeze(frozen) is frozen


def test_results_do_not_change_with_what_they_were_made_of():
    given = {"n": [1]}
    cd = 1e-4 * np.eye(2)
    parts = {"crpix": [5, 5], "cd": cd, "crval": [1, 2], "pv": PVPolynomial()}
    solution = DistortionSolution(
        "a", (10, 10), statistics=given, settings=given, provenance=given, **parts
    )
    calibration = Calibration(
        "f", solution, crval=[1, 2], cd=cd, statistics=given, settings=given, provenance=given
    )
    camera = Camera(
        "c", ("a",), "a", [[0, 0]], [np.eye(2)], [[10, 10]], cd,
        learned=given, files=given, solutions={"a": solution}, provenance=given,
    )  # fmt: skip
    given["n"].append(2)
    given["m"] = 1
    results = (solution, calibration, camera)
    names = {field.name for one in results for field in dataclasses.fields(one)}
    for one in (*results, pickle.loads(pickle.dumps(calibration))):
        found = [getattr(one, name) for name in sorted(names) if hasattr(one, name)]
        assert {type(value) for value in found if isinstance(value, dict)} == {FrozenDict}
        for name in ("statistics", "settings", "provenance", "learned", "files"):
            assert getattr(one, name, {"n": (1,)}) == {"n": (1,)}
