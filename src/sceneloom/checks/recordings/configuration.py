"""Rules about `vio_config.yaml`, the settings of the vendor's software that lie beside a recording."""

from collections.abc import Iterator

from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.formats.recording.further_contents import VIO_CONFIG_FILE
from sceneloom.formats.recording.vio_config import VioConfig, read_vio_config, repeated_keys, similar_key
from sceneloom.formats.recording.vio_config_keys import KNOWN_KEYS
from sceneloom.scene.findings import Severity


def _text(subject: Subject) -> str:
    """The text of the settings; "" where there are none, and for what is no recording."""
    if subject.recording is None:
        return ""
    kept = subject.scene.metadata.get("recording", {})
    text = kept.get("vio_config") if hasattr(kept, "get") else None
    return text if isinstance(text, str) else ""


def _config(subject: Subject) -> VioConfig:
    return read_vio_config(_text(subject))


def _unknown(subject: Subject) -> Iterator[Hit]:
    for setting in _config(subject).settings:
        if setting.key not in KNOWN_KEYS:
            near = similar_key(setting.key)
            meant = "" if near is None else f"; is {near!r} meant?"
            yield Hit(
                f"{VIO_CONFIG_FILE}: line {setting.line}", f"{setting.key!r} is not publicly known{meant}"
            )


def _repeated(subject: Subject) -> Iterator[Hit]:
    for key in repeated_keys(_text(subject)):
        lines = [str(s.line) for s in _config(subject).settings if s.key == key]
        yield Hit(
            f"{VIO_CONFIG_FILE}: line {lines[1]}",
            f"{key!r} stands in lines {', '.join(lines)}; expected once",
        )


def _strange(subject: Subject) -> Iterator[Hit]:
    for number, line in _config(subject).strange.items():
        yield Hit(f"{VIO_CONFIG_FILE}: line {number}", f"{line[:60]!r}; expected a setting, `key: value`")


RULES: tuple[Rule, ...] = (
    Rule(
        "config-keys-known",
        Severity.WARNING,
        "Every setting of `vio_config.yaml` has a name that is publicly known.",
        "See whether it is misspelt: the vendor's software stops at settings that it does not know.",
        find=_unknown,
    ),
    Rule(
        "config-keys-unique",
        Severity.WARNING,
        "No setting of `vio_config.yaml` stands there twice.",
        "Leave one of them out.",
        find=_repeated,
    ),
    Rule(
        "config-lines-settings",
        Severity.WARNING,
        "Every line of `vio_config.yaml` is a setting, `key: value`, or belongs to the one above it.",
        "Write a blank behind the colon, indent what belongs to a setting, or mark the line as a comment with `#`.",
        find=_strange,
    ),
)
"""Rules that read the settings as they are kept."""
