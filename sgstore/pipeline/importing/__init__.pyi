# The face of this package: what others may import from it.

from ._resolve import Words as Words
from ._run import FORMATS as FORMATS
from ._run import Imported as Imported
from ._run import import_graphs as import_graphs

__all__ = ["FORMATS", "Imported", "Words", "import_graphs"]
