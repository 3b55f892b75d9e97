"""Reader of logs of 123D (nuPlan, Argoverse 2, nuScenes, Waymo, KITTI-360, … in one layout of Arrow files)."""

__all__ = []
