"""Results as plain files: all of one kind appear together, or none does."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from namod_ctl.core.errors import StoreError
from namod_ctl.store.frames import sync_folder


def write_results(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write the named files into `folder`; older files of these names stay until every new one is on the disk.

    Raises
    ------
    StoreError
        The disk is full, or the folder can not be written; then every file is as it was before.
    """
    temporaries = {name: folder / f".{name}.tmp" for name in files}
    try:
        for name, data in files.items():
            with temporaries[name].open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        for name, temporary in temporaries.items():
            temporary.replace(folder / name)
        sync_folder(folder)
    except OSError as error:
        raise StoreError(
            f"{folder}: the results could not be written ({error.strerror}); free some space or allow writing there, "
            "and run the command again; nothing was changed"
        ) from error
    finally:
        for temporary in temporaries.values():
            temporary.unlink(missing_ok=True)
