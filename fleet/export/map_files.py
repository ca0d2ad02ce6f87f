"""Write features of the map as GeoJSON (RFC 7946) or KML (OGC 2.2)."""

import json
from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Any
from xml.etree import ElementTree

from fleet.export.features import MapFeature, date
from fleet.export.geometry import cut_at_antimeridian

_KML = "http://www.opengis.net/kml/2.2"
_STYLES = {  # colour aabbggrr, width; as on the viewer's page
    "flown_path": ("ffde963e", 3),
    "position": ("ffde963e", 1),
    "predicted_path": ("ff9ac42b", 3),
    "beyond_horizon": ("ff94887f", 1),
    "prediction_region": ("409ac42b", 1),
    "horizon": ("ff42e4f0", 2),
    "alert": ("ff356bff", 2),
}


def geojson(features: Iterable[MapFeature]) -> dict[str, Any]:
    """Return a FeatureCollection."""
    return {"type": "FeatureCollection", "features": [_geojson_feature(feature) for feature in features]}


def geojson_text(features: Iterable[MapFeature]) -> str:
    """Return a FeatureCollection as text."""
    return json.dumps(geojson(features), ensure_ascii=False, allow_nan=False) + "\n"


def _geojson_feature(feature: MapFeature) -> dict[str, Any]:
    kind, coordinates = cut_at_antimeridian(feature.geometry, feature.coordinates)
    geometry = {"type": kind, "coordinates": coordinates} if kind else None
    properties = {"kind": feature.kind, "uav": feature.uav, "time": date(feature.t), **feature.properties}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def kml_text(features: Sequence[MapFeature]) -> str:
    """Return a KML document with one folder per aircraft; altitudes are above mean sea level."""
    root = ElementTree.Element("kml", xmlns=_KML)
    document = ElementTree.SubElement(root, "Document")
    ElementTree.SubElement(document, "name").text = "ParaUAV"
    for kind, (colour, width) in _STYLES.items():
        style = ElementTree.SubElement(document, "Style", id=kind)
        line = ElementTree.SubElement(style, "LineStyle")
        ElementTree.SubElement(line, "color").text = colour
        ElementTree.SubElement(line, "width").text = str(width)
        ElementTree.SubElement(ElementTree.SubElement(style, "PolyStyle"), "color").text = colour
    for uav, own in groupby(features, key=lambda feature: feature.uav):
        folder = ElementTree.SubElement(document, "Folder")
        ElementTree.SubElement(folder, "name").text = f"uav-{uav}"
        for feature in own:
            _placemark(folder, feature)
    ElementTree.indent(root, " ")
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _placemark(folder: ElementTree.Element, feature: MapFeature) -> None:
    placemark = ElementTree.SubElement(folder, "Placemark")
    about = [f"{name}: {value}" for name, value in feature.properties.items()]
    ElementTree.SubElement(placemark, "name").text = f"uav-{feature.uav} {feature.kind.replace('_', ' ')}"
    ElementTree.SubElement(placemark, "description").text = "\n".join(about)
    if when := date(feature.t):
        ElementTree.SubElement(ElementTree.SubElement(placemark, "TimeStamp"), "when").text = when
    ElementTree.SubElement(placemark, "styleUrl").text = f"#{feature.kind}"
    if not feature.geometry:
        return
    kind, coordinates = cut_at_antimeridian(feature.geometry, feature.coordinates)
    if parts := kind.startswith("Multi"):
        placemark = ElementTree.SubElement(placemark, "MultiGeometry")
    for part in coordinates if parts else [coordinates]:
        _shape(placemark, kind.removeprefix("Multi"), part)


def _shape(parent: ElementTree.Element, geometry: str, coordinates: Any) -> None:
    shape = ElementTree.SubElement(parent, geometry)
    ElementTree.SubElement(shape, "altitudeMode").text = "absolute"
    points, holder = coordinates, shape
    if geometry == "Polygon":
        (points,) = points
        holder = ElementTree.SubElement(ElementTree.SubElement(shape, "outerBoundaryIs"), "LinearRing")
    points = [points] if geometry == "Point" else points
    ElementTree.SubElement(holder, "coordinates").text = " ".join(",".join(map(str, point)) for point in points)
