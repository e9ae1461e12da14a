"""Measurement models: a scan and a map in, a likelihood over poses out."""

from learned.geometric import GeometricMatcher
from learned.map_raster import CLASSES, MapRaster
from learned.matcher import MapMatcher, SearchRegion, load_matcher
from learned.rotmatch import RotMatch

__all__ = ["CLASSES", "GeometricMatcher", "MapMatcher", "MapRaster", "RotMatch", "SearchRegion", "load_matcher"]
