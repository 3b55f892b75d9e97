"""Programs of other clients: each counts the rows of the ego in an export, and prints the number.

``tests/edges/test_clients.py`` runs those that are installed; ``make clients`` runs each in an environment of
its own, with several versions of DuckDB.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Client:
    """A client: its packages, the modules that it needs, and a program.

    The arguments of the program are ``scenes.duckdb``, the folder of Parquet tables, and an empty folder.
    """

    packages: tuple[str, ...]
    modules: tuple[str, ...]
    program: str


DUCKDB = """
import sys, duckdb
db = duckdb.connect(sys.argv[1], read_only=True)
views = [name for (name,) in db.execute(
    "SELECT view_name FROM duckdb_views() WHERE NOT internal AND schema_name = 'main'").fetchall()]
assert len(views) > 20, views
for name in views:
    db.execute(f"SELECT * FROM {name} LIMIT 3").fetchall()
(count,) = db.execute("SELECT count(*) FROM nodes WHERE is_ego AND trace = 'town'").fetchall()[0]
db.execute("SELECT trace, relation, count(*) FROM edges GROUP BY ALL").fetchall()
print(count)
"""
IBIS = """
import sys, ibis
nodes = ibis.duckdb.connect(sys.argv[1], read_only=True).table("nodes")
print(nodes.filter(nodes.is_ego).count().execute())
"""
SQLALCHEMY = """
import sys, sqlalchemy
engine = sqlalchemy.create_engine(
    f"duckdb:///{sys.argv[1]}", connect_args={"read_only": True, "config": {}})
with engine.connect() as connection:
    print(connection.execute(sqlalchemy.text("SELECT count(*) FROM nodes WHERE is_ego")).scalar())
"""
DBT = """
import pathlib, sys
from dbt.cli.main import dbtRunner
place = pathlib.Path(sys.argv[3])
(place / "models").mkdir()
(place / "dbt_project.yml").write_text("name: drives\\nversion: '1.0'\\nprofile: drives\\n")
(place / "profiles.yml").write_text(
    "drives:\\n  target: dev\\n  outputs:\\n    dev:\\n      type: duckdb\\n"
    f"      path: {place / 'marts.duckdb'}\\n      attach:\\n"
    f"        - path: {sys.argv[1]}\\n          alias: scenes\\n          read_only: true\\n")
(place / "models" / "egos.sql").write_text("SELECT * FROM scenes.main.nodes WHERE is_ego")
done = dbtRunner().invoke(
    ["--quiet", "run", "--project-dir", str(place), "--profiles-dir", str(place)])
assert done.success, done
import duckdb
print(duckdb.connect(str(place / "marts.duckdb")).execute("SELECT count(*) FROM egos").fetchall()[0][0])
"""
PANDAS = """
import sys, pandas
print(int(pandas.read_parquet(f"{sys.argv[2]}/nodes.parquet").is_ego.sum()))
"""
POLARS = """
import sys, polars
print(polars.scan_parquet(f"{sys.argv[2]}/nodes.parquet").filter("is_ego").collect().height)
"""
DATASETS = """
import sys, datasets
nodes = datasets.load_dataset(sys.argv[2], "nodes", split="train", cache_dir=sys.argv[3])
print(sum(nodes["is_ego"]))
"""
SPARK = """
import sys
from pyspark.sql import SparkSession
spark = SparkSession.builder.master("local[1]").config("spark.ui.enabled", "false").getOrCreate()
print(spark.read.parquet(f"{sys.argv[2]}/nodes.parquet").filter("is_ego").count())
"""
LANCE = """
import sys, lance, pyarrow.parquet
table = pyarrow.parquet.read_table(f"{sys.argv[2]}/nodes.parquet")
lance.write_dataset(table, f"{sys.argv[3]}/nodes.lance")
print(lance.dataset(f"{sys.argv[3]}/nodes.lance").count_rows("is_ego"))
"""

CLIENTS = {
    **{
        f"duckdb {version}": Client((f"duckdb=={version}",), ("duckdb",), DUCKDB)
        for version in ("1.0.*", "1.1.*", "1.2.*", "1.3.*", "1.4.*", "1.5.*", "2.*")
    },
    "ibis": Client(("ibis-framework[duckdb]",), ("ibis", "duckdb"), IBIS),
    "sqlalchemy": Client(("duckdb-engine", "setuptools"), ("duckdb_engine",), SQLALCHEMY),
    "dbt": Client(("dbt-duckdb>=1.9,<1.11", "dbt-core>=1.9,<1.11"), ("dbt.adapters.duckdb",), DBT),
    "pandas": Client(("pandas", "pyarrow"), ("pandas", "pyarrow"), PANDAS),
    "polars": Client(("polars",), ("polars",), POLARS),
    "datasets": Client(("datasets",), ("datasets",), DATASETS),
    "spark": Client(("pyspark>=4.1,<5",), ("pyspark",), SPARK),
    "lance": Client(("pylance", "pyarrow"), ("lance", "pyarrow"), LANCE),
}
