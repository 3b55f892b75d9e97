"""Examples of each command of ``sgstore`` for its help text: a command line with its purpose."""

from __future__ import annotations

from typing import Final

EXAMPLES: Final[dict[str, tuple[str, ...]]] = {
    "": (
        "demo  # all of it on the bundled recording, into sgstore-demo/",
        "find drives.sgstore -p jaywalking  # the matches of a library pattern",
    ),
    "ingest": (
        "ingest drives.sgstore recordings/  # the new recordings of a folder",
        "ingest drives.sgstore 'day*/**/*.mcap' --jobs 4  # four recordings at a time",
    ),
    "info": (
        "info drives.sgstore  # its traces",
        "info drives.sgstore --trace town  # details of one trace",
    ),
    "doctor": (
        "doctor town.mcap  # list the readable contents and the faults",
        "doctor recordings/ --json  # the same for all files of a folder, for a program",
    ),
    "record": (
        "record drive.mcap --duration 60s  # a minute of a running CARLA",
        "record drive.mcap --sensors sensors.toml --ego hero  # with sensors on its ego",
    ),
    "import": (
        "import graphs.sgstore town02.csv.xz --format s3c  # graphs of S3C",
        "import graphs.sgstore edges.csv --format csv --kind sedan=car  # edges of a graph, a line each",
    ),
    "verify": (
        "verify drives.sgstore  # check that the store is unchanged",
        "verify drives.sgstore --payloads  # check its recordings, too",
    ),
    "remove": (
        "remove drives.sgstore monday  # remove a trace",
        "remove drives.sgstore --compact  # free the space of removed traces",
    ),
    "rebuild": (
        "rebuild drives.sgstore --jobs 4  # from its recordings",
        "rebuild drives.sgstore --look-in /data/moved  # after the recordings moved",
    ),
    "derive": (
        "derive drives.sgstore --config near.toml --as near  # relations with other thresholds",
        "derive drives.sgstore  # list the sets of relations",
    ),
    "map": (
        "map Town01.xodr -o map.png  # list the contents and draw a picture",
        "map town.mcap --json  # the map in a recording",
    ),
    "payload": (
        "payload drives.sgstore town#264  # channels of a frame",
        "payload drives.sgstore town#264 /ego/camera/front/image -o frame.jpg  # the camera picture",
    ),
    "config": (
        "config > settings.toml  # all settings, each with its meaning",
        "config --list  # the presets",
    ),
    "demo": (
        "demo  # on the bundled recording, into sgstore-demo/",
        "demo first-steps  # into another folder",
    ),
    "find": (
        "find drives.sgstore 'MATCH (e:Ego)-[:near_coll]->(v:Vehicle) WHERE e.speed > 5'  # near misses",
        "find drives.sgstore -p jaywalking --count  # the number of frames with a match",
    ),
    "why-not": (
        "why-not drives.sgstore town@20s -p jaywalking  # the first condition that fails in this frame",
        "why-not drives.sgstore town#200 'MATCH (e:Ego) WHERE e.speed > 20'  # and the nearest value",
    ),
    "like": (
        "like drives.sgstore town@20s  # the best frames of each trace",
        "like drives.sgstore town@20s --ignore person --all  # all runs of frames, without persons",
    ),
    "translate": (
        "translate properties.py  # translate SGSM properties to the query language",
        "translate properties.py -o properties.sgql  # to be checked: sgstore check STORE properties.sgql",
    ),
    "sql": (
        "sql drives.sgstore 'SELECT kind, avg(speed) FROM nodes GROUP BY kind'  # the views are plain SQL",
        "sql drives.sgstore 'SELECT * FROM frames' -o frames.parquet  # as a file",
    ),
    "patterns": (
        "patterns search pedestrian crossing  # by words",
        "patterns run drives.sgstore cut_in  # the matches and their entities",
    ),
    "patterns list": (
        "patterns list  # all of them",
        "patterns list --kind property --json  # rules, for a program",
    ),
    "patterns search": (
        "patterns search pedestrian crossing  # the best first",
        "patterns search lane change --kind scenario  # of one kind",
    ),
    "patterns show": (
        "patterns show cut_in  # text, parameters, source, and a scene",
        "patterns show cut_in -o cut_in.sgql  # to change it: sgstore find STORE -f cut_in.sgql",
    ),
    "patterns run": (
        "patterns run drives.sgstore cut_in within=3s  # with a parameter",
        "patterns run drives.sgstore jaywalking --clips --before 2s --json  # as clips, for a program",
    ),
    "check": (
        "check drives.sgstore -e 'CHECK slow: ALWAYS ego.speed < 14'  # a rule, and its verdicts",
        "check drives.sgstore rules.sgql --require --junit verdicts.xml  # in a build, with exit code 4",
    ),
    "monitor": (
        "monitor town.mcap rules.sgql  # frame by frame, like a live run",
        "monitor carla://localhost:2000 -p phi1 --duration 60s  # a running CARLA",
    ),
    "timeline": (
        "timeline drives.sgstore -p cut_in -f rules.sgql -o when.png  # matches and violations, as a picture",
        "timeline drives.sgstore -p crossing_pedestrian --parts town@26.4s  # where each part of it holds",
    ),
    "coverage": (
        "coverage classes drives.sgstore  # count the scenes and estimate the unseen ones",
        "coverage of new.sgstore --by drives.sgstore  # the share of known scenes",
    ),
    "coverage classes": (
        "coverage classes drives.sgstore --picture classes.png  # and their frequencies",
        "coverage classes drives.sgstore --abstraction EL --unit trace  # the number of traces with each class",
    ),
    "coverage of": (
        "coverage of new.sgstore --by drives.sgstore  # by classes and by frames",
        "coverage of drives.sgstore --by tests.lock  # the coverage of a test set",
    ),
    "coverage novel": (
        "coverage novel new.sgstore --not-in drives.sgstore  # the rarest first",
        "coverage novel new.sgstore --not-in drives.sgstore --list clips  # where they are",
    ),
    "coverage venn": (
        "coverage venn monday.sgstore tuesday.sgstore  # two stores",
        "coverage venn 'drives.sgstore:MATCH (e:Ego) WHERE e.speed > 8' drives.sgstore  # fast frames, and all",
    ),
    "coverage growth": (
        "coverage growth drives.sgstore --picture growth.png  # estimate the gain of more data",
        "coverage growth drives.sgstore --unit trace --points 10  # trace by trace",
    ),
    "coverage combos": (
        "coverage combos drives.sgstore --ego --picture gaps.png  # pairs that never occur together",
        "coverage combos drives.sgstore --k 3 --slots slots.toml --missing  # of declared slots",
    ),
    "coverage sequences": (
        "coverage sequences drives.sgstore --covered  # sequences of manoeuvres, with a place",
        "coverage sequences new.sgstore --by drives.sgstore --missing  # the missing sequences",
    ),
    "coverage spec": (
        "coverage spec drives.sgstore --slots slots.toml --missing  # of a declared specification",
        "coverage spec drives.sgstore 'MATCH (e:Ego), (v:Vehicle) RETURN v.kind' --cells 5  # of a query",
    ),
    "coverage windows": (
        "coverage windows drives.sgstore --window 10  # ten frames form a class together",
        "coverage windows drives.sgstore --abstraction E --incomplete drop  # only whole windows",
    ),
    "coverage explain": (
        "coverage explain new.sgstore --vs drives.sgstore  # features that differ most",
        "coverage explain new.sgstore --vs drives.sgstore --tree  # a decision tree that separates them",
    ),
    "coverage failures": (
        "coverage failures --train old.sgstore --test new.sgstore --outcomes runs.csv  # the novel failures",
        "coverage failures --train old.sgstore --test new.sgstore --outcomes runs.csv --json  # for a program",
    ),
    "select": (
        "select drives.sgstore --minimal --unit clip -o tests.lock  # the fewest clips with all classes",
        "select drives.sgstore --rarest --budget 10min --unit clip  # ten minutes of the rarest",
    ),
    "criticality": (
        "criticality drives.sgstore -m pet -m tet  # criticality measures, one row for each pair",
        "criticality drives.sgstore -m pet --most 1.5 -o close.csv  # the close pairs, as a table",
    ),
    "prioritize": (
        "prioritize drives.sgstore --unit clip -o order.lock  # the most critical first",
        "prioritize drives.sgstore --outcomes runs.csv --picture found.png  # the failures found over time",
    ),
    "diff": (
        "diff before.sgstore after.sgstore -p cut_in  # list new and lost matches",
        "diff before.sgstore after.sgstore --by-frame --require  # in a build: exit code 4 if scenes differ",
    ),
    "lock": (
        "lock verify tests.lock drives.sgstore  # check that the set is unchanged",
        "lock union monday.lock tuesday.lock -o both.lock  # two sets as one",
    ),
    "lock verify": (
        "lock verify tests.lock drives.sgstore  # recordings, settings, graphs, sensor messages",
        "lock verify tests.lock drives.sgstore --no-payloads  # without reading recordings",
    ),
    "lock list": (
        "lock list tests.lock  # its cases",
        "lock list tests.lock -o cases.csv  # as a file",
    ),
    "lock union": (
        "lock union monday.lock tuesday.lock -o both.lock  # cases of either",
        "lock union tests.lock new.lock -o tests2.lock  # a set grows",
    ),
    "lock intersect": (
        "lock intersect monday.lock tuesday.lock -o same.lock  # cases of both",
        "lock intersect tests.lock failed.lock -o again.lock  # the failed cases of a set",
    ),
    "lock minus": (
        "lock minus tests.lock known.lock -o open.lock  # the remaining cases",
        "lock minus new.lock tests.lock -o added.lock  # the added cases",
    ),
    "show": (
        "show drives.sgstore town@26.4s -o frame.png  # the top view and the camera picture",
        "show drives.sgstore town@25s..31s -p crossing_pedestrian -o clip.gif  # a clip, the match marked",
    ),
    "export": (
        "export drives.sgstore -p crossing_pedestrian --to clips --before 2s  # with the original messages",
        "export drives.sgstore -p cut_in --format xosc --to scenarios  # to be driven again",
    ),
    "shrink": (
        "shrink drives.sgstore -p cut_in --to least  # cut to the fewest frames that still match",
        "shrink drives.sgstore 'CHECK ALWAYS ego.speed < 9' --clip town@0s..30s --to least  # that violate",
    ),
    "serve": (
        "serve drives.sgstore --open  # a page on this machine",
        "serve before.sgstore --compare after.sgstore --open  # two stores, side by side",
    ),
    "report": (
        "report drives.sgstore -p crossing_pedestrian --pictures -o crossing.html  # a page, as a file",
        "report drives.sgstore 'CHECK ALWAYS ego.speed < 14' --around 3s  # violations, with 3 s around each",
    ),
    "mcp": (
        "mcp drives.sgstore  # the line for the settings of an assistant",
        "mcp drives.sgstore --write-to clips --timeout 20s  # which may export clips",
    ),
    "collection": (
        "collection pack drives.sgstore fleet/  # a store becomes a collection",
        "collection verify fleet/  # check that all files are unchanged",
    ),
    "collection pack": (
        "collection pack drives.sgstore fleet/  # into a folder",
        "collection pack drives.sgstore s3://bucket/fleet --bundle-traces 100  # into an object store",
    ),
    "collection commit": (
        "collection commit fleet/  # add the landed recordings",
        "collection commit s3://bucket/fleet --json  # for a program",
    ),
    "collection unpack": (
        "collection unpack fleet/ drives.sgstore  # one store of all",
        "collection unpack s3://bucket/fleet drives.sgstore  # from an object store",
    ),
    "collection verify": (
        "collection verify fleet/  # check that all files are unchanged",
        "collection verify s3://bucket/fleet --json  # for a program",
    ),
    "collection rebuild": (
        "collection rebuild fleet/  # after an update: bundles of an old version",
        "collection rebuild fleet/ --all --look-in /data/moved  # all of them, from recordings that moved",
    ),
    "collection gc": (
        "collection gc fleet/ --dry-run  # list the unused files",
        "collection gc fleet/ --keep 3 --older 60min  # remove it, but keep three snapshots",
    ),
}
"""Verb → the rest of the command line, and the purpose."""


def examples_of(verb: str) -> str:
    """Return the examples of a command as text for its help; empty without examples.

    They have no frame and no line breaks, so that users can copy them.
    """
    lines: list[str] = []
    for one in EXAMPLES.get(verb, ()):
        typed, _, purpose = one.rpartition("  # ")
        lines += ["", f"   # {purpose}", f"   sgstore {typed}"]
    return "\n".join([" Examples:", *lines[1:], "", ""]) if lines else ""
