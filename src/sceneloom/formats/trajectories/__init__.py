"""Trajectories in files of their own: TUM, KITTI, EuRoC, GNSS, named columns, lines of JSON; or out of a scene."""
