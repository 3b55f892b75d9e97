"""Rules that valid rows of a store satisfy, as SQL that returns the traces with invalid rows.

They cover bit masks of frames, numbers of frames, and references between rows and to the road map.
"""

from __future__ import annotations

from typing import Final

from sgstore.store._columns import REPEATED, STATES
from sgstore.store._packing import LONGEST_STEP
from sgstore.store._publish import SHARED

_MASKS: Final[tuple[tuple[str, str], ...]] = (
    *(("edge", "an edge holds"), ("world_edge", "an edge holds")),
    *(("node", "a static node is present"), ("world_node", "a static node is present")),
    *((table, f"a row of {table} is") for table in REPEATED.values()),
)
"""Table with a bit mask of frames, and the words for one of its rows."""

RULES: Final[tuple[tuple[str, str, str], ...]] = (
    *(
        (
            "masks",
            f"{what} in no frame, or in frames that the trace does not have",
            f"""
            SELECT r.bucket >> 18 FROM {table} r LEFT JOIN bucket b ON b.bucket = r.bucket
            WHERE b.bucket IS NULL OR r.mask = 0 OR (r.mask & ~b.valid) <> 0""",
        )
        for table, what in _MASKS
    ),
    (
        "masks",
        "the frames of a bucket differ from its number of frames, or are not consecutive",
        f"""
        SELECT coalesce(b.trace_id, f.trace_id)
        FROM bucket b FULL JOIN (
          SELECT bucket, any_value(trace_id) AS trace_id, bit_or(one) AS valid,
                 bit_or(CASE WHEN step BETWEEN 0 AND {LONGEST_STEP} THEN one ELSE 0 END) AS joined
          FROM (SELECT f.bucket, f.trace_id, t.period_ns, 1::BIGINT << f.bit AS one,
                       f.time_ns - lag(f.time_ns) OVER (PARTITION BY f.trace_id ORDER BY f.frame_id) AS step
                FROM frame f LEFT JOIN trace t ON t.trace_id = f.trace_id)
          GROUP BY bucket) f ON f.bucket = b.bucket
        WHERE b.valid IS DISTINCT FROM f.valid OR b.trace_id IS DISTINCT FROM f.trace_id
           OR b.joined IS DISTINCT FROM f.joined""",
    ),
    (
        "frames",
        "the number of frames differs from that of the trace, or the numbers do not run from 0 without gaps",
        """
        SELECT t.trace_id FROM trace t LEFT JOIN (
          SELECT trace_id, count(*) AS frames, count(DISTINCT seq) AS seqs, min(seq) AS first,
                 max(seq) AS last
          FROM frame GROUP BY trace_id) f ON f.trace_id = t.trace_id
        WHERE coalesce(f.frames, 0) <> t.frames OR f.seqs <> t.frames OR f.first <> 0
           OR f.last <> t.frames - 1""",
    ),
    (
        "frames",
        "a frame's id is not that of its trace and number",
        """
        SELECT trace_id FROM frame
        WHERE bucket <> (trace_id << 18) + seq // 60 OR bit <> seq % 60 OR frame_id <> (bucket << 6) + bit""",
    ),
    (
        "references",
        "rows of a trace that is not in the store",
        "SELECT f.trace_id FROM frame f WHERE f.trace_id NOT IN (SELECT trace_id FROM trace)",
    ),
    (
        "references",
        "a recording, settings or a map that are not in the store",
        """
        SELECT trace_id FROM trace
        WHERE config_id NOT IN (SELECT config_id FROM config)
           OR recording_id NOT IN (SELECT recording_id FROM recording)
           OR (map_id IS NOT NULL AND map_id NOT IN (SELECT map_id FROM map))""",
    ),
    *(
        (
            "references",
            f"the number of a {table} is not that of its digest",
            f"SELECT NULL FROM {table} WHERE {table}_id <> ('0x' || digest[:15])::BIGINT",
        )
        for table in SHARED
    ),
    (
        "references",
        "a frame lies on another map than its trace",
        "SELECT f.trace_id FROM frame f JOIN trace t ON t.trace_id = f.trace_id"
        " WHERE f.map_id IS DISTINCT FROM t.map_id",
    ),
    (
        "references",
        "an ego is not an entity of the trace",
        "SELECT f.trace_id FROM frame f WHERE f.ego IS NOT NULL AND NOT EXISTS"
        " (SELECT 1 FROM entity e WHERE e.trace_id = f.trace_id AND e.node_id = f.ego)",
    ),
    *(
        (
            "references",
            "a state belongs to no entity or no frame, or has another kind than its entity",
            f"""
            SELECT s.frame_id >> 24 FROM {states} s
            LEFT JOIN entity e ON e.trace_id = s.frame_id >> 24 AND e.node_id = s.node_id
            LEFT JOIN frame f ON f.frame_id = s.frame_id
            WHERE e.kind IS DISTINCT FROM s.kind OR f.frame_id IS NULL""",
        )
        for states in STATES
    ),
    (
        "references",
        "an entity is in the graph of a frame and beyond it",
        "SELECT w.frame_id >> 24 FROM world_state w JOIN state s USING (frame_id, node_id)",
    ),
    (
        "references",
        "an entity lies in a lane missing from its map, or is not an entity of the trace",
        """
        SELECT l.bucket >> 18
        FROM (SELECT bucket, node_id, kind, lane FROM lane_single UNION ALL
              SELECT bucket, node_id, kind, lane FROM lane_repeated UNION ALL
              SELECT bucket, node_id, kind, lane FROM world_lane_single UNION ALL
              SELECT bucket, node_id, kind, lane FROM world_lane_repeated) l
        LEFT JOIN trace t ON t.trace_id = l.bucket >> 18
        LEFT JOIN entity e ON e.trace_id = t.trace_id AND e.node_id = l.node_id
        LEFT JOIN map_node m ON m.map_id = t.map_id AND m.node_id = l.lane
        WHERE e.kind IS DISTINCT FROM l.kind OR m.node_id IS NULL""",
    ),
    *(
        (
            "references",
            f"an edge {way} a node that is not in the trace or its map, or its kind differs",
            f"""
            SELECT e.bucket >> 18
            FROM (SELECT DISTINCT bucket, {end} AS node, {end}_kind AS kind
                  FROM (SELECT * FROM edge UNION ALL SELECT * FROM world_edge)) e
            LEFT JOIN trace t ON t.trace_id = e.bucket >> 18
            LEFT JOIN entity n ON n.trace_id = t.trace_id AND n.node_id = e.node
            LEFT JOIN map_node m ON m.map_id = t.map_id AND m.node_id = e.node
            WHERE coalesce(n.kind, m.kind) IS DISTINCT FROM e.kind""",
        )
        for end, way in (("src", "comes from"), ("dst", "leads to"))
    ),
    (
        "references",
        "a static node is neither an entity of the trace nor a part of its map, or its kind differs",
        """
        SELECT k.bucket >> 18 FROM (SELECT * FROM node UNION ALL SELECT * FROM world_node) k
        LEFT JOIN trace t ON t.trace_id = k.bucket >> 18
        LEFT JOIN entity n ON n.trace_id = t.trace_id AND n.node_id = k.node_id
        LEFT JOIN map_node m ON m.map_id = t.map_id AND m.node_id = k.node_id
        WHERE coalesce(n.kind, m.kind) IS DISTINCT FROM k.kind""",
    ),
    (
        "references",
        "a payload is of no channel or of no frame",
        """
        SELECT p.trace_id FROM payload p
        LEFT JOIN channel c ON c.trace_id = p.trace_id AND c.channel_id = p.channel_id
        LEFT JOIN frame f ON f.bucket = p.bucket AND f.bit = p.bit
        WHERE c.channel_id IS NULL OR f.frame_id IS NULL""",
    ),
    (
        "map",
        "an edge of a map leads to a node outside the map",
        """
        SELECT NULL FROM map_edge e
        LEFT JOIN map_node a ON a.map_id = e.map_id AND a.node_id = e.src
        LEFT JOIN map_node b ON b.map_id = e.map_id AND b.node_id = e.dst
        WHERE a.kind IS DISTINCT FROM e.src_kind OR b.kind IS DISTINCT FROM e.dst_kind""",
    ),
    (
        "map",
        "a way along lanes of a map leads to a node that is not a lane of it",
        """
        SELECT NULL FROM map_reach r
        LEFT JOIN map_node a ON a.map_id = r.map_id AND a.node_id = r.src
        LEFT JOIN map_node b ON b.map_id = r.map_id AND b.node_id = r.dst
        WHERE a.kind IS DISTINCT FROM 'lane' OR b.kind IS DISTINCT FROM 'lane'""",
    ),
    (
        "map",
        "a place along lanes of a map belongs to a node outside the map, or lies on a node that is not a lane",
        """
        SELECT NULL FROM map_place p
        LEFT JOIN map_node a ON a.map_id = p.map_id AND a.node_id = p.node_id
        LEFT JOIN map_node b ON b.map_id = p.map_id AND b.node_id = p.lane
        WHERE a.kind IS NULL OR b.kind IS DISTINCT FROM 'lane'""",
    ),
    (
        "map",
        "a course of a lane of a map belongs to a node that is not a lane",
        """
        SELECT NULL FROM map_course c
        LEFT JOIN map_node n ON n.map_id = c.map_id AND n.node_id = c.lane
        WHERE n.kind IS DISTINCT FROM 'lane'""",
    ),
)
"""Rules: name of the check, text of the fault, and SQL that returns the ids of the invalid traces."""
