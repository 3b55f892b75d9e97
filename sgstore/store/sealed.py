"""A trace that is ready to be published: files in a folder, and what is said of them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Self

from sgstore.errors import StoreError
from sgstore.store.checksums import Checksum
from sgstore.store.traces import Identity

_FILE: Final = "sealed.json"


@dataclass(frozen=True, slots=True)
class Sealed:
    """A segment that is complete. It needs nothing of the process that built it.

    Attributes
    ----------
    folder : Path
    path : Path
        The recording.
    identity : Identity
    files : dict
        Table → names of its Parquet files in the folder, in the order in which they are published.
    checksums : dict
        Table → checksum of its rows.
    map_checksums : dict
        The same of the tables of the map, which may be in the store already.
    """

    folder: Path
    path: Path
    identity: Identity
    files: dict[str, list[str]]
    checksums: dict[str, Checksum]
    map_checksums: dict[str, Checksum]

    def write(self) -> None:
        """Write into the folder what :meth:`read` needs.

        Raises
        ------
        StoreError
            It cannot be written.
        """
        values = asdict(self) | {"folder": "", "path": str(self.path)}
        try:
            (self.folder / _FILE).write_text(json.dumps(values), encoding="utf-8")
        except OSError as error:
            raise StoreError(f"{self.folder}: cannot be written: {error.strerror}") from error

    @classmethod
    def read(cls, folder: Path) -> Self:
        """What a process of ours sealed in a folder.

        Raises
        ------
        StoreError
            There is nothing.
        """
        try:
            values = json.loads((folder / _FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise StoreError(f"{folder}: no segment that is complete: {error}") from error
        return cls(
            folder=folder,
            path=Path(values["path"]),
            identity=Identity.from_dict(values["identity"]),
            files=values["files"],
            checksums=_checksums(values["checksums"]),
            map_checksums=_checksums(values["map_checksums"]),
        )


def _checksums(values: dict[str, Any]) -> dict[str, Checksum]:
    return {table: Checksum(**checksum) for table, checksum in values.items()}
