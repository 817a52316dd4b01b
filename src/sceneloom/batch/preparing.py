"""Before a run begins: whose location it is, which drives are new, which have to be done anew."""

import secrets
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from hashlib import blake2b
from typing import Any

from sceneloom.batch.files import with_files
from sceneloom.batch.further import Locations, check_locations
from sceneloom.batch.jobs import Input, Job, State
from sceneloom.batch.naming import output_names
from sceneloom.batch.outputs import FolderOutputs, Outputs, claimed
from sceneloom.batch.record import Record, Row
from sceneloom.errors import OptionError, OutputError
from sceneloom.formats.fingerprints import fingerprint
from sceneloom.redaction import redacted
from sceneloom.version import __version__

DriveKey = tuple[str, tuple[tuple[str, Any], ...]]
"""What reports drives apart: where they are, and what counts for them alone."""

_SIDE_BY_SIDE = 16
"""How many drives are looked at together."""


def open_outputs(store: str, record: Record, *, resume: bool) -> Outputs:
    """Give where outputs go; a record belongs to one location for good.

    Args:
        store: a location in a store; "" for the folder of the record.
        record: of the run.
        resume: whether it may have drives already.

    Raises:
        OutputError: it has, or the location is that of another run.
    """
    known = record.reported()
    before, now = known.get("store", ""), redacted(store)
    if before != now and record.rows():
        location = before or "it"
        raise OutputError(
            f"{record.folder}: holds the record of a run with outputs in {location}; name another one"
        )
    _refuse_known(record, resume=resume)
    record.notify("store", now)
    if not store:
        return FolderOutputs(record.folder)
    name = known.get("run") or secrets.token_hex(8)
    record.notify("run", name)
    return claimed(store, run=name, record=record.folder)


def _refuse_known(record: Record, *, resume: bool) -> None:
    known = len(record.rows())
    if known and not resume:
        raise OutputError(
            f"{record.folder}: holds a run over {known} drives already; `--resume` goes on with it, "
            "or choose another folder"
        )


def prepare(job: Job, record: Record, outputs: Outputs) -> None:
    """Enter the drives, and let those be done anew that changed.

    Raises:
        OutputError: a file that is no output of the run has the name of one.
        OptionError: drives differ in secrets of their addresses only, or two outputs of one in nothing.
        DataError: the server of a drive does not answer.
    """
    locations = Locations()
    known = {drive_key(row.input, row.part): row for row in record.rows()}
    asked = asked_drives(job)
    taken = {row.output for row in known.values()}
    new = []
    for drive, name in zip(job.inputs, output_names(job.inputs, job.suffix), strict=True):
        if drive_key(drive.name, drive.options) in known:
            continue
        free = next(own for own in _numbered(name, job.suffix) if own not in taken)
        if outputs.has(free):
            raise OutputError(f"{outputs.name.rstrip('/')}/{free}: exists already; choose another folder")
        further = further_locations(job, free)
        check_locations([f"{outputs.location.rstrip('/')}/{free}", *further.values()])
        for location in filter(locations.has, further.values()):
            raise OutputError(f"{redacted(location)}: exists already; choose another folder")
        taken.add(free)
        new.append((drive.name, drive.options, free))
    record.add(new)
    record.notify("verb", job.verb)
    record.notify("sceneloom", __version__)
    reported = {**job.options, **job.files}
    record.notify("options", {name: redacted(repr(value)) for name, value in reported.items()})
    meant = {row.number: asked[key] for key, row in known.items() if key in asked}
    done = done_rows(
        job, outputs, record, {row.number: row for row in known.values() if row.number in meant}, meant
    )
    record.wait_again([number for number in meant if number not in done])


def drive_key(location: str, part: Mapping[str, Any]) -> DriveKey:
    """What reports a drive apart in the record."""
    return location, tuple(sorted(part.items()))


def asked_drives(job: Job) -> dict[DriveKey, Input]:
    """The drives by what the record reports them apart by."""
    found: dict[DriveKey, Input] = {}
    for drive in job.inputs:
        if found.setdefault(drive_key(drive.name, drive.options), drive).location != drive.location:
            raise OptionError(
                f"{drive.name}: two drives differ in secrets only, which no record keeps; do them apart"
            )
    return found


def _numbered(name: str, suffix: str) -> Iterator[str]:
    stem, number = name.removesuffix(suffix), 1
    while True:
        yield name if number == 1 else f"{stem}~{number}{suffix}"
        number += 1


def further_locations(job: Job, output: str) -> dict[str, str]:
    """Where the further outputs of a drive belong, by option."""
    return {one.option: one.of(output.removesuffix(job.suffix)) for one in job.further}


def files_of(job: Job, drive: Input) -> dict[str, Any]:
    """What the verb reads beside a drive, by option."""
    return {**job.files, **drive.files}


def done_rows(
    job: Job, outputs: Outputs, record: Record, rows: Mapping[int, Row], meant: Mapping[int, Input]
) -> set[int]:
    """Drives that are done as the job wants them, where neither they nor their outputs changed since."""
    locations = Locations()

    def has_further(number: int) -> bool:
        report = record.report(number) if job.further else None
        made = report.get("further", {}) if isinstance(report, dict) else {}
        wanted = further_locations(job, rows[number].output)
        return all(locations.has(location) for option, location in wanted.items() if option in made)

    perhaps = [
        number
        for number, row in rows.items()
        if row.state is State.DONE
        and row.fingerprint
        and row.configuration == configuration(job, meant[number], row.part)
        and outputs.has(row.output)
        and has_further(number)
    ]
    with ThreadPoolExecutor(_SIDE_BY_SIDE) as thread_pool:  # servers take their time to answer
        asked = [meant[number] for number in perhaps]
        once = list(
            dict.fromkeys(drive.location for drive in asked)
        )  # drives of a data set lie in one location
        seen = dict(zip(once, thread_pool.map(fingerprint, once), strict=True))
        now = thread_pool.map(lambda drive: with_files(seen[drive.location], files_of(job, drive)), asked)
        return {
            number for number, found in zip(perhaps, now, strict=True) if found == rows[number].fingerprint
        }


def configuration(job: Job, drive: Input, part: Mapping[str, Any]) -> str:
    """Report what is done with a drive from anything else: the verb, its options, our version."""
    stated = {**job.options, **files_of(job, drive), **part}
    options = sorted((name, redacted(repr(value))) for name, value in stated.items())
    reported = repr((__version__, job.verb, job.call, options))
    return blake2b(reported.encode("utf-8", "surrogateescape"), digest_size=16).hexdigest()
