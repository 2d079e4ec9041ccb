"""The panel of left against right, without a browser."""

import numpy as np
import pytest
import xarray as xr

pytest.importorskip("anywidget")
import s4a
from s4a.geometry.mesh import vertex_normals
from s4a_morphometrics import asymmetry


@pytest.fixture(scope="module")
def found(study):
    return asymmetry(study, n_permutations=15)


def test_directional_and_fluctuating_asymmetry_and_that_of_an_individual_are_maps(study, found):
    one = s4a.widgets.Asymmetry(study, found)
    one.where.value = "everywhere"
    np.testing.assert_array_equal(one.values()[0], found["directional_normal"].values)
    assert f"antisymmetry p = {found['antisymmetry_p'].item():.3g}" in one.scene.caption
    one.map.value = "fluctuating"
    np.testing.assert_array_equal(one.values()[0], found["fluctuating"].values)
    assert one.values()[1:] == (False, "mm")
    one.map.value, one.individual.value = "individual", "brain_03"
    a = found["asymmetry"].sel(individual="brain_03").values
    X = found["symmetric_position"].values
    np.testing.assert_allclose(one.values()[0], (a * vertex_normals(X, one.T)).sum(1))
    np.testing.assert_array_equal(one.scene.surface[0], X)
    assert one.scene.title == "asymmetry of brain_03"
    one.close()


def test_a_study_with_a_result_has_a_tab_of_it_and_one_without_has_none(study, found):
    with_result = study.assign({"asymmetry": xr.DataTree(found)})
    tabs = s4a.explore(with_result)
    assert tabs["Asymmetry"].known[0] == ("directional asymmetry", "directional_normal")
    tabs.close()
    tabs = s4a.explore(study)
    assert "Asymmetry" not in tabs.kinds
    tabs.close()


def test_without_a_result_the_panel_names_the_missing_node(study):
    with pytest.raises(ValueError, match="needs asymmetry/directional"):
        s4a.widgets.Asymmetry(study)
