"""Modules have names of the field, and no file is large or holds anything of one machine."""

import re

import pytest

REFUSED_NAMES = {"util", "utils", "common", "core", "helper", "helpers", "misc", "manager", "managers", "tools"}
LARGEST_FILE = 1_000_000

MACHINE_PATHS = re.compile(r"(?<![\w.~$}-])/(?:root|work|home|Users|mnt|data|scratch)/\w")
HOSTS = ("pypi.org", "pythonhosted.org", "conda.anaconda.org", "index-url", "find-links", "artifactory", "nexus")
QUOTES_THE_HOSTS = "tests/architecture/test_shape.py"


def test_a_module_is_named_after_what_it_is_about(modules_of_room):
    for module in modules_of_room:
        refused = REFUSED_NAMES & set(module.name.split("."))
        assert not refused, f"{module.name}: {refused} says nothing about its content"


def test_a_folder_of_modules_is_a_package(modules_of_room):
    for module in modules_of_room:
        assert (module.path.parent / "__init__.py").is_file(), module.name


def test_no_file_is_large(project_files, project):
    large = {str(p.relative_to(project)): p.stat().st_size for p in project_files if p.stat().st_size > LARGEST_FILE}
    assert not large


def test_no_file_holds_a_path_of_one_machine_or_the_host_of_a_registry(project_files, project):
    found = []
    for path in project_files:
        name = path.relative_to(project).as_posix()
        text = path.read_bytes().decode("utf-8", "replace")
        if name == QUOTES_THE_HOSTS or "\0" in text:
            continue
        found += [f"{name}: {match.group()}" for match in MACHINE_PATHS.finditer(text)]
        found += [f"{name}: {host}" for host in HOSTS if host in text]
    assert not found


@pytest.mark.parametrize("text", ["see /root/x", "'/work/main/a'", "at /home/someone", "file:///Users/a"])
def test_paths_of_one_machine_are_noticed(text):
    assert MACHINE_PATHS.search(text)


@pytest.mark.parametrize("text", ["a/work/b", "$HOME/work/x", "../shared/data/x", "/tmp/x", "rows/data"])
def test_relative_paths_are_not_mistaken_for_paths_of_one_machine(text):
    assert not MACHINE_PATHS.search(text)
