"""The nuScenes schema: a folder of tables in JSON, and the files of sensors that they name."""
