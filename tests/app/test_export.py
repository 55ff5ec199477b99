"""KML and GeoJSON of a run: parsed back, every position where it should be, and what is refused."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import graphslam
from graphslam.app.cli import app
from graphslam.app.export import export, geographic_map, parse_datum
from graphslam.core.errors import ConfigError, GeometryError, UnknownNameError
from graphslam.core.geometry import se2_transform
from graphslam.io.geographic import KML_NAMESPACE, GeographicMap, write_geojson, write_kml
from tests.reference.local_tangent import geodetic_to_enu

DATUM = (-33.88, 151.19)
NS = {"k": KML_NAMESPACE}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    log = graphslam.simulate("landmark-field", preset="quick", seed=3, gps_rate=1.0, gps_sigma=0.3)
    return graphslam.run(log, out=tmp_path_factory.mktemp("run") / "r", progress=False)


def enu(coordinates):
    """East, north of [lon, lat] pairs."""
    c = np.asarray(coordinates, dtype=float).reshape(-1, 2)
    return geodetic_to_enu(np.column_stack([c[:, 1], c[:, 0], np.zeros(len(c))]), *DATUM)[:, :2]


def kml_coordinates(element):
    return [[float(v) for v in word.split(",")] for word in element.text.split()]


def test_geojson_reads_back_in_place(run):
    assert run.gps, "the simulated log was asked for GPS"
    value = json.loads(export(run, DATUM, format="geojson").read_text())
    kinds = [f["properties"]["kind"] for f in value["features"]]
    n = len(run.map.landmarks)
    assert [kinds.count(k) for k in ("path", "landmark", "ellipse", "gps")] == [1, n, n, 1]
    T = run.gps["all"].T_gps_map
    by_kind = {k: [f for f in value["features"] if f["properties"]["kind"] == k] for k in set(kinds)}
    path = enu(by_kind["path"][0]["geometry"]["coordinates"])
    np.testing.assert_allclose(path, se2_transform(T, run.map.trajectory.positions), atol=2e-3)
    marks = np.array([enu(f["geometry"]["coordinates"])[0] for f in by_kind["landmark"]])
    np.testing.assert_allclose(marks, se2_transform(T, run.map.landmarks), atol=2e-3)
    fixes = enu(by_kind["gps"][0]["geometry"]["coordinates"])
    np.testing.assert_allclose(fixes, run.gps["all"].points + run.gps["all"].residuals, atol=2e-3)
    lon0, lat0, lon1, lat1 = value["bbox"]
    assert lon0 < DATUM[1] + 0.01
    assert lat0 < lat1
    assert lon0 < lon1


def test_ellipses_are_the_covariances_and_turn_the_right_way(run):
    value = json.loads(export(run, DATUM, format="geojson", confidence=0.5).read_text())
    ellipses = [f for f in value["features"] if f["properties"]["kind"] == "ellipse"]
    T = run.gps["all"].T_gps_map
    c, s = np.cos(T[2]), np.sin(T[2])
    R = np.array([[c, -s], [s, c]])
    for f, centre, P in zip(ellipses, se2_transform(T, run.map.landmarks), run.map.landmark_covariances):
        assert f["properties"]["confidence"] == 0.5
        ring = f["geometry"]["coordinates"][0]
        assert ring[0] == ring[-1]
        d = enu(ring) - centre
        d2 = np.einsum("ni,ij,nj->n", d, np.linalg.inv(R @ P @ R.T), d)
        np.testing.assert_allclose(d2, 1.386, rtol=0.05)  # χ² of two degrees of freedom, 50 %
        x, y = np.asarray(ring).T
        assert np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) > 0  # counter-clockwise, RFC 7946


def test_kml_reads_back_in_place(run):
    root = ET.parse(export(run, DATUM, format="kml")).getroot()
    assert root.tag == f"{{{KML_NAMESPACE}}}kml"
    path = root.find(".//k:LineString/k:coordinates", NS)
    T = run.gps["all"].T_gps_map
    expected = se2_transform(T, run.map.trajectory.positions)
    np.testing.assert_allclose(enu(kml_coordinates(path)), expected, atol=2e-3)
    folders = root.findall(".//k:Folder", NS)
    assert len(folders) == 2
    assert len(folders[0].findall("k:Placemark", NS)) == len(run.map.landmarks)
    assert len(folders[1].findall("k:Placemark", NS)) == len(run.gps["all"].points)
    styles = {f"#{s.get('id')}" for s in root.findall(".//k:Style", NS)}
    assert {u.text for u in root.findall(".//k:styleUrl", NS)} <= styles


def test_names_are_escaped_and_an_empty_map_is_a_file(tmp_path):
    empty = GeographicMap(name="<&\"'>", description="a < b")
    write_kml(tmp_path / "m.kml", empty)
    assert ET.parse(tmp_path / "m.kml").getroot().find(".//k:name", NS).text == "<&\"'>"
    write_geojson(tmp_path / "m.json", empty)
    assert json.loads((tmp_path / "m.json").read_text())["features"] == []
    with pytest.raises(GeometryError, match="differ in number"):
        GeographicMap(name="x", landmarks=np.zeros((2, 2)))
    with pytest.raises(GeometryError, match="path is not"):
        GeographicMap(name="x", path=np.array([[np.nan, 0.0]]))


def without_gps(run):
    return replace(run, gps={})


def test_without_gps_the_user_says_where_the_first_base_looks(run):
    plain = without_gps(run)
    with pytest.raises(ConfigError, match="heading"):
        geographic_map(plain, DATUM)
    m = geographic_map(plain, DATUM, heading=90.0)  # it looks east: x is east
    np.testing.assert_allclose(enu(m.path[:, ::-1]), run.map.trajectory.positions, atol=2e-3)
    north = geographic_map(plain, DATUM, heading=0.0)
    turned = run.map.trajectory.positions @ [[0.0, 1.0], [-1.0, 0.0]]
    np.testing.assert_allclose(enu(north.path[:, ::-1]), turned, atol=2e-3)
    assert len(m.gps) == 0


def test_what_cannot_be_exported_is_refused(run, tmp_path):
    with pytest.raises(UnknownNameError, match="kml"):
        export(run, DATUM, format="kmz")
    with pytest.raises(ConfigError, match="defines the heading"):
        export(run, DATUM, format="kml", heading=3.0)
    with pytest.raises(GeometryError, match="latitude"):
        export(run, (95.0, 0.0), format="kml")
    with pytest.raises(ConfigError, match="LAT,LON"):
        parse_datum("151.2")
    with pytest.raises(ConfigError, match="file name"):
        export(replace(run, folder=None), DATUM, format="kml")


def test_command_line(run, tmp_path):
    out = tmp_path / "m.geojson"
    arguments = [
        "export",
        str(run.folder),
        "--format",
        "geojson",
        "--datum",
        "-33.88,151.19",
        "--out",
        str(out),
        "--json",
    ]
    done = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["file"] == str(out)
    assert json.loads(out.read_text())["type"] == "FeatureCollection"
