"""Writer of georeferenced maps as KML (Google Earth) and GeoJSON (GIS): path, landmarks with ellipses, GPS fixes.

Both formats have longitude before latitude, in degrees of WGS 84. KML: OGC 07-147r2 (2.2). GeoJSON: RFC 7946, rings
counter-clockwise.
"""

from __future__ import annotations

import json
import os
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.atomic import atomic_open
from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array
from graphslam.core.markup import plain_text

KML_NAMESPACE = "http://www.opengis.net/kml/2.2"
_DIGITS = 9  # decimals of a degree: 0.1 mm


@dataclass(frozen=True, slots=True, kw_only=True)
class GeographicMap:
    """Content of a georeferenced map; every position is latitude, longitude [deg].

    Parameters
    ----------
    path : (n, 2)
    landmarks : (k, 2)
    landmark_ids : (k,) int64
    landmark_sigmas : (k,)
        Largest σ of each landmark's position [m].
    ellipses : (k, m, 2)
        Confidence ellipses of the landmarks as closed rings, counter-clockwise seen from above.
    confidence : float
        Confidence of the ellipses.
    gps : (g, 2)
        GPS fixes; may be empty.
    """

    name: str
    description: str = ""
    path: Array = field(default_factory=lambda: np.zeros((0, 2)))
    landmarks: Array = field(default_factory=lambda: np.zeros((0, 2)))
    landmark_ids: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    landmark_sigmas: Array = field(default_factory=lambda: np.zeros(0))
    ellipses: Array = field(default_factory=lambda: np.zeros((0, 5, 2)))
    confidence: float = 0.95
    gps: Array = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        k = len(self.landmarks)
        if len(self.landmark_ids) != k or len(self.landmark_sigmas) != k or len(self.ellipses) != k:
            raise GeometryError(
                "landmarks, ids, sigmas and ellipses differ in number",
                got=(k, len(self.landmark_ids), len(self.landmark_sigmas), len(self.ellipses)),
            )
        for name in ("path", "landmarks", "gps", "ellipses"):
            a = np.asarray(getattr(self, name))
            if a.shape[-1] != 2 or not np.all(np.isfinite(a)):
                raise GeometryError(f"{name} is not latitude and longitude", got=a.shape, wanted="finite (..., 2)")


def write_kml(path: str | os.PathLike[str], content: GeographicMap) -> None:
    """Write a KML file with the path and folders of landmarks and, if any, of GPS fixes."""
    ET.register_namespace("", KML_NAMESPACE)
    root = ET.Element(_tag("kml"))
    document = _child(root, "Document")
    _child(document, "name", content.name)
    _child(document, "description", content.description)
    for name, colour, width in (("path", "ffb27200", "2"), ("ellipse", "ff005ed5", "1")):  # aabbggrr
        style = _child(document, "Style", id=name)
        line = _child(style, "LineStyle")
        _child(line, "color", colour)
        _child(line, "width", width)
        if name == "ellipse":
            _child(_child(style, "PolyStyle"), "color", "40005ed5")
    fix = _child(document, "Style", id="fix")
    icon = _child(fix, "IconStyle")
    _child(icon, "color", "ff739e00")
    _child(icon, "scale", "0.3")
    if len(content.path) > 1:
        mark = _placemark(document, "path", "path")
        line = _child(mark, "LineString")
        _child(line, "tessellate", "1")
        _child(line, "coordinates", _coordinates(content.path))
    landmarks = _folder(document, f"landmarks ({len(content.landmarks)})")
    for i, where, sigma, ring in zip(
        content.landmark_ids.tolist(), content.landmarks, content.landmark_sigmas.tolist(), content.ellipses
    ):
        mark = _placemark(landmarks, f"landmark {i}", "ellipse")
        _child(mark, "description", f"σ {sigma:.3g} m; the ring is the {content.confidence:.0%} ellipse")
        both = _child(mark, "MultiGeometry")
        _child(_child(both, "Point"), "coordinates", _coordinates(where[None]))
        boundary = _child(_child(_child(both, "Polygon"), "outerBoundaryIs"), "LinearRing")
        _child(boundary, "coordinates", _coordinates(ring))
    if len(content.gps):
        fixes = _folder(document, f"GPS ({len(content.gps)} fixes)")
        for k, where in enumerate(content.gps):
            mark = _placemark(fixes, "", "fix")
            mark.set("id", f"fix-{k}")
            _child(_child(mark, "Point"), "coordinates", _coordinates(where[None]))
    ET.indent(root)
    with atomic_open(path, "w") as stream:
        stream.write('<?xml version="1.0" encoding="UTF-8"?>\n')
        stream.write(ET.tostring(root, encoding="unicode") + "\n")


def _tag(name: str) -> str:
    return f"{{{KML_NAMESPACE}}}{name}"


def _child(parent: ET.Element, name: str, text: str | None = None, **attributes: str) -> ET.Element:
    element = ET.SubElement(parent, _tag(name), attributes)
    element.text = None if text is None else plain_text(text)  # XML has no control characters
    return element


def _folder(parent: ET.Element, name: str) -> ET.Element:
    folder = _child(parent, "Folder")
    _child(folder, "name", name)
    return folder


def _placemark(parent: ET.Element, name: str, style: str) -> ET.Element:
    mark = _child(parent, "Placemark")
    if name:
        _child(mark, "name", name)
    _child(mark, "styleUrl", f"#{style}")
    return mark


def _coordinates(points: Iterable[Any]) -> str:
    return " ".join(f"{lon:.{_DIGITS}f},{lat:.{_DIGITS}f}" for lat, lon in points)


def write_geojson(path: str | os.PathLike[str], content: GeographicMap) -> None:
    """Write a GeoJSON feature collection; ``kind`` of a feature is path, landmark, ellipse or gps."""
    features: list[dict[str, Any]] = []

    def add(kind: str, geometry: str, coordinates: Any, **properties: Any) -> None:
        features.append(
            {
                "type": "Feature",
                "geometry": {"type": geometry, "coordinates": coordinates},
                "properties": {"kind": kind, **properties},
            }
        )

    if len(content.path) > 1:
        add("path", "LineString", _pairs(content.path), name=content.name, description=content.description)
    for i, where, sigma, ring in zip(
        content.landmark_ids.tolist(), content.landmarks, content.landmark_sigmas.tolist(), content.ellipses
    ):
        add("landmark", "Point", _pairs(where[None])[0], id=i, sigma_m=sigma)
        add("ellipse", "Polygon", [_pairs(ring)], id=i, confidence=content.confidence)
    if len(content.gps):
        add("gps", "MultiPoint", _pairs(content.gps), fixes=len(content.gps))
    every = np.concatenate([content.path, content.landmarks, content.ellipses.reshape(-1, 2), content.gps])
    value: dict[str, Any] = {"type": "FeatureCollection", "features": features}
    if len(every):
        low, high = every.min(axis=0), every.max(axis=0)
        value["bbox"] = [round(float(v), _DIGITS) for v in (low[1], low[0], high[1], high[0])]
    with atomic_open(path, "w") as stream:
        json.dump(value, stream, allow_nan=False)
        stream.write("\n")


def _pairs(points: Array) -> list[list[float]]:
    return [[round(float(lon), _DIGITS), round(float(lat), _DIGITS)] for lat, lon in points]
