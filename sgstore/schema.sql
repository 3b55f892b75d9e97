-- sgstore: what is in a store, version 5.
--
-- Users' SQL sees the VIEWS at the end of this file: frames, nodes, edges, pairs, lanes, entities, payloads.
-- They are public and keep their columns. The TABLES are in the schema "inside" and may change with the version.
--
-- Ids. A trace is one recording seen from one ego. Its trace_id is 39 bits of a digest of both, so it is the same
-- in every store. Its frames are numbered by seq = 0, 1, 2, …; 60 consecutive frames are a bucket:
--     bucket   = trace_id · 2^18 + seq // 60         never spans traces
--     frame_id = bucket · 64 + seq % 60              so trace_id = frame_id >> 24, bucket = frame_id >> 6
-- A node_id names a node within its trace: 0 and above are entities of the trace, below zero parts of its map
-- (-1 is off_road). A mask holds 60 frames of a bucket: bit i is the frame with seq % 60 = i.
-- A recording, a road map and a set of settings are known by their digests (SHA-256): recording_id, map_id and config_id are
-- the first 60 bits of them, so they are the same in every store, too, and rows of one store can be put into another as they are.
-- Two of a million have the same 60 bits with a chance of 4 in 10 million; the second one is refused by name.
--
-- Enumerations are those of vocabulary.py, in its order (a test holds the two together). When a trace comes with a kind or a
-- state of lights, or can answer a relation, that the type does not have, it is added behind the others, in place.
--
-- Changes
--   * Version 5: what is known beyond the graphs, out to [range] world: world_state, world_lane_single, world_lane_repeated, world_node;
--     known_state, known_lane_state, known_node: both together. The views world_nodes, world_pairs, world_lane_states, world_lane_dists.
--     entity.world_parked, entity.lifetime.
--   * Version 4: map_place, map_course. recordings, with a row for each however many egos were seen in it; maps and settings by their digests; gear and hand brake.
--     Tables are in a schema of their own. Kinds and states of lights are open, as relations are; attributes of a client's own. The kind 'vehicle'. pairs.ttc: first contact; pairs.closing_time: what it was. What stands for ever has velocity 0.
--     The view criticality. Columns that are always known are NOT NULL; store_info holds a digest of these statements.
--     Places in lanes and gaps that are the same in frames of a bucket that follow one another are kept once: lane_single, lane_repeated,
--     gap_single, gap_repeated, put together by the views lane_state and lane_gap. state.repeated.
--   * Version 3: bucket.joined; the states of the ego lie together (state, lane_state).
--   * Version 2: events. pairs.lon_gap, pairs.lat_gap, pairs.apparent_heading; lane_dists, by lane_state.is_own and map_reach. roles, by lane_role.
--   * state.special, state.subkind: constants of the entity, repeated so that the view nodes needs no join with entity
--     (a join of 10 million states costs a second, the two columns cost nothing: they are dictionaries).
--   * channel_id, section, lane are INTEGER: the numbers come from files, and cost the same space.
--   * What may be missing is NULL everywhere: texts too (never the empty string).

CREATE TYPE kind AS ENUM (
  'car', 'truck', 'van', 'bus', 'motorcycle', 'bicycle', 'trailer', 'train', 'vehicle', 'person', 'animal',
  'traffic_light', 'stop_sign', 'yield_sign', 'speed_limit', 'sign', 'prop', 'building', 'pole', 'barrier', 'vegetation', 'unknown',
  'lane', 'road', 'junction', 'crosswalk', 'off_road', 'waypoint', 'roundabout');

CREATE TYPE relation AS ENUM (
  'isIn', 'travelsTo', 'laneChange', 'opposes', 'toLeftOf', 'toRightOf', 'conflictsWith', 'controlsTrafficOf', 'mayAffect',
  'safety_hazard', 'near_coll', 'super_near', 'very_near', 'near', 'visible',
  'inDFrontOf', 'inSFrontOf', 'atSRearOf', 'atDRearOf', 'leads', 'follows', 'overlaps', 'sees', 'tows');

CREATE TYPE light_state AS ENUM ('unknown', 'off', 'red', 'yellow', 'green', 'red_yellow', 'flashing');

CREATE SCHEMA inside; -- of the tables: who opens the file sees nothing but the views
USE inside;

-- What the store is -----------------------------------------------------------------------------------------------

CREATE TABLE store_info (key VARCHAR NOT NULL, value VARCHAR NOT NULL); -- schema_version, created_by

-- The digest: of the settings and, of flavours that need one, of the mapping by which a recording is understood.
CREATE TABLE config (config_id BIGINT NOT NULL, digest VARCHAR NOT NULL, settings JSON NOT NULL); -- one row for each set of settings in use

-- Traces ----------------------------------------------------------------------------------------------------------

CREATE TABLE recording (                                       -- a file, or a bag of several: one row, whatever the number of egos
  recording_id BIGINT NOT NULL,
  digest     VARCHAR NOT NULL,     -- SHA-256 of the whole file
  uri        VARCHAR NOT NULL,     -- absolute path when it was ingested
  place      VARCHAR,              -- the same from the folder of the store, where it lies below it, else NULL: both may be moved together
  size       BIGINT NOT NULL,      -- with mtime_ns it tells that the file was replaced
  mtime_ns   BIGINT NOT NULL
);

CREATE TABLE trace (
  trace_id   BIGINT NOT NULL,      -- 39 bits of sha256(digest, ego)
  name       VARCHAR NOT NULL,     -- unique; the file's name without its ending
  recording_id BIGINT NOT NULL,
  flavour    VARCHAR NOT NULL,     -- the reader: 'osi'
  ego        VARCHAR,              -- the simulator's id of the ego, NULL without one
  since      DOUBLE,               -- seconds of the recording from which on its frames were read, NULL: from the first
  until      DOUBLE,               -- and up to which, included, NULL: to the last
  map_id     BIGINT,               -- NULL without a map
  config_id  BIGINT NOT NULL,
  frames     INTEGER NOT NULL,
  start_ns   BIGINT NOT NULL,      -- simulation time of the first and of the last frame
  end_ns     BIGINT NOT NULL,
  period_ns  BIGINT NOT NULL,      -- median difference of consecutive frames
  uneven     TINYINT,              -- bits of what is no pair of bodies: 1 flat things, 2 storeys, 4 trailers and riders, 8 and 16 as 1 and 2 among what moves; NULL: not known
  origin_x   DOUBLE NOT NULL,      -- positions in state are relative to it
  origin_y   DOUBLE NOT NULL,
  origin_z   DOUBLE NOT NULL,
  answers    VARCHAR[] NOT NULL,   -- relations that this trace can answer; of the others nothing is known
  report     JSON NOT NULL,        -- what reading it brought to light: losses, warnings, unknown types
  ingested_at TIMESTAMP NOT NULL,
  version    VARCHAR NOT NULL      -- of sgstore
);

-- Channels, context and payloads are the trace's, not the recording's: the role of a channel, the part that was read and the
-- tolerance with which messages are joined are settings, which may differ from ego to ego; a trace can be taken out of a store,
-- and put into another, with all that is its own; and payloads meet frames by bucket, so that a window over frames reaches them.
CREATE TABLE channel (                                         -- channels of the traces' files
  trace_id BIGINT NOT NULL, channel_id INTEGER NOT NULL, topic VARCHAR, schema VARCHAR, schema_encoding VARCHAR, message_encoding VARCHAR,
  role VARCHAR);                                               -- ground_truth, map, payload

CREATE TABLE context (                                         -- messages that later ones depend on: maps, static data
  trace_id BIGINT NOT NULL, channel_id INTEGER NOT NULL, log_time_ns BIGINT NOT NULL, chunk_offset BIGINT NOT NULL, "offset" BIGINT NOT NULL, length BIGINT NOT NULL);

CREATE TABLE entity (                                          -- what does not change about an entity of a trace
  trace_id BIGINT NOT NULL, node_id INTEGER NOT NULL, kind kind NOT NULL, ident VARCHAR, special VARCHAR, subkind VARCHAR, type_name VARCHAR,
  is_static BOOLEAN NOT NULL, map_ref VARCHAR, parked BOOLEAN, -- parked: of vehicles, NULL where it is not known
  world_parked BOOLEAN,                                        -- the same, as far as what is known beyond the graphs says
  lifetime INTEGER NOT NULL,                                   -- 1, 2, …: which of the entities with this ident; an id may return as another one
  x FLOAT, y FLOAT, z FLOAT, heading FLOAT, length FLOAT, width FLOAT, height FLOAT);   -- pose of the static ones, else NULL

-- Frames ----------------------------------------------------------------------------------------------------------

CREATE TABLE bucket (bucket BIGINT NOT NULL, trace_id BIGINT NOT NULL, map_id BIGINT,
  valid BIGINT NOT NULL,                                       -- mask of its frames
  joined BIGINT NOT NULL);                                     -- mask of those at most 2.5 periods after the one before

CREATE TABLE frame (                                           -- ordered by frame_id
  frame_id BIGINT NOT NULL, bucket BIGINT NOT NULL, bit TINYINT NOT NULL, trace_id BIGINT NOT NULL, map_id BIGINT, seq INTEGER NOT NULL,
  time_ns BIGINT NOT NULL, log_time_ns BIGINT NOT NULL, ego INTEGER); -- ego: node_id, NULL where it is absent

CREATE TABLE state (                                           -- ordered by is_ego (first), repeated, kind, bucket, node_id, frame_id
  kind kind NOT NULL, frame_id BIGINT NOT NULL, node_id INTEGER NOT NULL, is_ego BOOLEAN NOT NULL,
  x FLOAT, y FLOAT, z FLOAT,                                   -- about the trace's origin
  heading FLOAT, pitch FLOAT, roll FLOAT,                      -- rad
  speed FLOAT, vx FLOAT, vy FLOAT, vz FLOAT, ax FLOAT, ay FLOAT, az FLOAT, yaw_rate FLOAT,
  length FLOAT, width FLOAT, height FLOAT,
  lights SMALLINT, light_state light_state, steer FLOAT, throttle FLOAT, brake FLOAT,
  gear TINYINT, hand_brake BOOLEAN,                            -- gear: below 0 backwards, 0 neutral
  derived TINYINT,
  carrier INTEGER,                                             -- node_id of what pulls or carries it
  special VARCHAR, subkind VARCHAR,                            -- as in entity
  repeated BOOLEAN NOT NULL);                                  -- as its row before or after, in a bucket: such rows lie together, and take little space

CREATE TABLE node (kind kind NOT NULL, bucket BIGINT NOT NULL, node_id INTEGER NOT NULL, mask BIGINT NOT NULL); -- presence of static nodes

CREATE TABLE edge (                                            -- ordered by all columns, in this order
  relation relation NOT NULL, src_is_ego BOOLEAN NOT NULL, dst_is_ego BOOLEAN NOT NULL, src_kind kind NOT NULL, dst_kind kind NOT NULL,
  bucket BIGINT NOT NULL, src INTEGER NOT NULL, dst INTEGER NOT NULL, mask BIGINT NOT NULL);

-- Places in lanes and gaps are of one frame, told by bucket and bit: a row of the table …_single. What is the same in frames of a bucket
-- that follow one another is one row of the table …_repeated, with a mask: of what stands for ever, and of who waits. The views lane_state
-- and lane_gap put both together again; they, and not the tables, are read by everything else.

CREATE TABLE lane_single (                                     -- attributes of isIn edges from entities to lanes
  kind kind NOT NULL, bucket BIGINT NOT NULL, bit TINYINT NOT NULL, node_id INTEGER NOT NULL, lane INTEGER NOT NULL,
  overlap FLOAT, lane_offset FLOAT, heading_error FLOAT, is_primary BOOLEAN NOT NULL, -- offset to the left, m; rad
  along FLOAT,                                                 -- of the centre, from the start of the lane, m
  is_own BOOLEAN NOT NULL, is_ego BOOLEAN NOT NULL);           -- one by which ways along the lanes are told; as in state

CREATE TABLE lane_repeated (
  kind kind NOT NULL, bucket BIGINT NOT NULL, mask BIGINT NOT NULL, node_id INTEGER NOT NULL, lane INTEGER NOT NULL,
  overlap FLOAT, lane_offset FLOAT, heading_error FLOAT, is_primary BOOLEAN NOT NULL, along FLOAT,
  is_own BOOLEAN NOT NULL, is_ego BOOLEAN NOT NULL);

CREATE TABLE gap_single (                                      -- attribute of the edges src follows dst and dst leads src
  bucket BIGINT NOT NULL, bit TINYINT NOT NULL, src INTEGER NOT NULL, dst INTEGER NOT NULL, gap FLOAT); -- from bumper to bumper along the lanes, m

CREATE TABLE gap_repeated (
  bucket BIGINT NOT NULL, mask BIGINT NOT NULL, src INTEGER NOT NULL, dst INTEGER NOT NULL, gap FLOAT);

-- Beyond the graphs: what is in range of [range] world (a circle around the ego), and not in the graph of a frame. Nothing that reads graphs
-- reads these tables. The views known_… are both together. Each has the columns of a table of graphs (store/_schema.py puts them in).

CREATE TABLE world_state ({{columns of state}});                 -- is_ego: never; ordered by repeated, kind, bucket, node_id, frame_id

CREATE TABLE world_node ({{columns of node}});

CREATE TABLE world_lane_single ({{columns of lane_single}});

CREATE TABLE world_lane_repeated ({{columns of lane_repeated}});

-- In which edges isIn, controlsTrafficOf, leads and follows all that is known differs from the graphs: it has those that these have not. It has
-- not those leads and follows that they have, where the next one ahead is out of range.
CREATE TABLE world_edge ({{columns of edge}});

CREATE TABLE world_gap_single ({{columns of gap_single}});

CREATE TABLE world_gap_repeated ({{columns of gap_repeated}});

CREATE TABLE frame_class (                                     -- ordered by all columns; made at ingest
  abstraction VARCHAR NOT NULL, class UUID, bucket BIGINT NOT NULL, mask BIGINT NOT NULL); -- class: NULL where too symmetric to be told

CREATE TABLE lane_role (                                       -- ordered by all columns; what lanes are to the ego in RSV
  role VARCHAR NOT NULL, bucket BIGINT NOT NULL, node_id INTEGER NOT NULL, mask BIGINT NOT NULL);

CREATE TABLE later_class (                                     -- the same of abstractions that were asked for later
  abstraction VARCHAR NOT NULL, class UUID, bucket BIGINT NOT NULL, mask BIGINT NOT NULL);

-- Other relations from the same states: sets that were derived, each under its name

CREATE TABLE derived (                                         -- one row for each set and trace
  name VARCHAR NOT NULL, trace_id BIGINT NOT NULL, settings JSON NOT NULL, digest VARCHAR NOT NULL, answers VARCHAR[] NOT NULL, derived_at TIMESTAMP NOT NULL, version VARCHAR NOT NULL);

CREATE TABLE derived_node (                                    -- all nodes of its graphs, those that move too
  set_name VARCHAR NOT NULL, moves BOOLEAN NOT NULL, kind kind NOT NULL, bucket BIGINT NOT NULL, node_id INTEGER NOT NULL, mask BIGINT NOT NULL);

CREATE TABLE derived_edge (                                    -- as edge
  set_name VARCHAR NOT NULL, relation relation NOT NULL, src_is_ego BOOLEAN NOT NULL, dst_is_ego BOOLEAN NOT NULL, src_kind kind NOT NULL, dst_kind kind NOT NULL,
  bucket BIGINT NOT NULL, src INTEGER NOT NULL, dst INTEGER NOT NULL, mask BIGINT NOT NULL);

CREATE TABLE derived_gap (                                     -- as gap_single
  set_name VARCHAR NOT NULL, bucket BIGINT NOT NULL, bit TINYINT NOT NULL, src INTEGER NOT NULL, dst INTEGER NOT NULL, gap FLOAT);

CREATE TABLE payload (                                         -- the message of each channel that belongs to a frame
  bucket BIGINT NOT NULL, bit TINYINT NOT NULL, trace_id BIGINT NOT NULL, channel_id INTEGER NOT NULL, log_time_ns BIGINT NOT NULL,
  chunk_offset BIGINT NOT NULL, "offset" BIGINT NOT NULL, length BIGINT NOT NULL);

CREATE TABLE event (                                           -- what the simulator says has happened
  trace_id BIGINT NOT NULL, frame_id BIGINT NOT NULL,          -- of the frame that is nearest in time
  time_ns BIGINT, log_time_ns BIGINT, kind VARCHAR NOT NULL, ident VARCHAR, other VARCHAR, value DOUBLE, detail VARCHAR,
  lifetime INTEGER NOT NULL, other_lifetime INTEGER NOT NULL); -- of the entities with ident and other

CREATE TABLE imported (                                        -- frames that came as graphs: what their file calls them
  bucket BIGINT NOT NULL, bit TINYINT NOT NULL, trace_id BIGINT NOT NULL, graph VARCHAR, place BIGINT NOT NULL, images BIGINT NOT NULL); -- place: row or line

CREATE TABLE attribute (                                       -- of a client's own: what no column takes, of nodes and edges of imported graphs
  frame_id BIGINT NOT NULL, node_id INTEGER NOT NULL, relation relation, dst INTEGER, -- of an edge from node_id; NULL: of the node itself
  attribute VARCHAR NOT NULL, value JSON NOT NULL);

-- Maps: once each, whatever the number of traces on them ----------------------------------------------------------

CREATE TABLE map (map_id BIGINT NOT NULL, digest VARCHAR NOT NULL, name VARCHAR NOT NULL, text VARCHAR);

CREATE TABLE map_node (
  map_id BIGINT NOT NULL, node_id INTEGER NOT NULL, kind kind NOT NULL, name VARCHAR, -- name: 'road/section/lane' of a lane, else the id in the map
  x DOUBLE, y DOUBLE, z DOUBLE, heading DOUBLE,                -- a point on it, and its direction there
  lane_type VARCHAR, road VARCHAR, section INTEGER, lane INTEGER, junction VARCHAR, turn VARCHAR,
  length FLOAT, width FLOAT, speed_limit FLOAT, curvature DOUBLE);   -- m, m (mean), m/s, 1/m

CREATE TABLE map_edge (                                        -- holds in a frame where both its ends are present
  map_id BIGINT NOT NULL, relation relation NOT NULL, src_kind kind NOT NULL, dst_kind kind NOT NULL, src INTEGER NOT NULL, dst INTEGER NOT NULL);

CREATE TABLE map_reach (                                       -- for each two lanes that a way of up to 200 m joins
  map_id BIGINT NOT NULL, src INTEGER NOT NULL, dst INTEGER NOT NULL, -- lanes, a lane and itself among them
  start DOUBLE NOT NULL);                                      -- of dst, from the start of src; below 0: one drives back to src; m

CREATE TABLE map_place (                                       -- where parts of a map lie along its lanes
  map_id BIGINT NOT NULL, node_id INTEGER NOT NULL, what VARCHAR NOT NULL, -- what: the kind of the part, or stop_line
  lane INTEGER NOT NULL, start DOUBLE NOT NULL, "end" DOUBLE NOT NULL); -- m from the start of the lane; a light, a sign: where one waits

CREATE TABLE map_course (                                      -- how lanes run, metre by metre
  map_id BIGINT NOT NULL, lane INTEGER NOT NULL,
  start DOUBLE NOT NULL, "end" DOUBLE,                         -- m from the start of the lane; end: NULL of its last stretch
  curvature DOUBLE NOT NULL, slope DOUBLE);                    -- 1/m, to the left; rise over run, NULL where the map has no heights

-- For sgstore verify ------------------------------------------------------------------------------------------------

CREATE TABLE manifest (                                        -- what was published: rows of a trace, a recording, a map, or settings
  owner VARCHAR NOT NULL, id BIGINT NOT NULL,                  -- 'trace' and its trace_id, 'recording', 'map', 'config'
  "table" VARCHAR NOT NULL, rows BIGINT NOT NULL, checksum BIGINT NOT NULL); -- store/_staging.py says how

-- For the compiler ------------------------------------------------------------------------------------------------

CREATE TABLE bits (bit TINYINT NOT NULL, m BIGINT NOT NULL);   -- 0 … 59 and 1 << bit
INSERT INTO bits SELECT range::TINYINT, 1::BIGINT << range FROM range(60);

-- Views for everything else: single and repeated rows together ----------------------------------------------------

CREATE VIEW inside.lane_state AS
SELECT kind, bucket * 64 + bit AS frame_id, bucket, bit, node_id, lane, overlap, lane_offset, heading_error, is_primary, along, is_own, is_ego
FROM inside.lane_single
UNION ALL
SELECT r.kind, r.bucket * 64 + b.bit, r.bucket, b.bit, r.node_id, r.lane, r.overlap, r.lane_offset, r.heading_error, r.is_primary, r.along,
       r.is_own, r.is_ego
FROM inside.lane_repeated r JOIN inside.bits b ON (r.mask & b.m) <> 0;

CREATE VIEW inside.lane_gap AS
SELECT bucket * 64 + bit AS frame_id, bucket, bit, src, dst, gap FROM inside.gap_single
UNION ALL
SELECT r.bucket * 64 + b.bit, r.bucket, b.bit, r.src, r.dst, r.gap FROM inside.gap_repeated r JOIN inside.bits b ON (r.mask & b.m) <> 0;

CREATE VIEW inside.known_state AS
SELECT *, true AS in_graph FROM inside.state UNION ALL SELECT *, false FROM inside.world_state;

CREATE VIEW inside.known_node AS
SELECT *, true AS in_graph FROM inside.node UNION ALL SELECT *, false FROM inside.world_node;

CREATE VIEW inside.known_edge AS
SELECT * FROM (SELECT * FROM inside.edge UNION ALL SELECT * FROM inside.world_edge)
WHERE relation <> 'leads' AND relation <> 'follows'
UNION ALL
SELECT relation, src_is_ego, dst_is_ego, src_kind, dst_kind, bucket, src, dst, bit_xor(mask) AS mask
FROM (SELECT * FROM inside.edge UNION ALL SELECT * FROM inside.world_edge)
WHERE relation = 'leads' OR relation = 'follows'
GROUP BY relation, src_is_ego, dst_is_ego, src_kind, dst_kind, bucket, src, dst;

CREATE VIEW inside.known_lane_gap AS
SELECT * FROM inside.lane_gap
UNION ALL
SELECT * FROM (
  SELECT bucket * 64 + bit AS frame_id, bucket, bit, src, dst, gap FROM inside.world_gap_single
  UNION ALL
  SELECT r.bucket * 64 + b.bit, r.bucket, b.bit, r.src, r.dst, r.gap FROM inside.world_gap_repeated r JOIN inside.bits b ON (r.mask & b.m) <> 0
);

CREATE VIEW inside.known_lane_state AS
SELECT *, true AS in_graph FROM inside.lane_state
UNION ALL
SELECT *, false FROM (
  SELECT kind, bucket * 64 + bit AS frame_id, bucket, bit, node_id, lane, overlap, lane_offset, heading_error, is_primary, along, is_own, is_ego
  FROM inside.world_lane_single
  UNION ALL
  SELECT r.kind, r.bucket * 64 + b.bit, r.bucket, b.bit, r.node_id, r.lane, r.overlap, r.lane_offset, r.heading_error, r.is_primary, r.along,
         r.is_own, r.is_ego
  FROM inside.world_lane_repeated r JOIN inside.bits b ON (r.mask & b.m) <> 0
);

-- The public views -------------------------------------------------------------------------------------------------
--
-- No NOT IN, and no UNION of three: versions of DuckDB write them down in different ways, and views are compared by their text.
-- One row per thing per frame; metres, seconds, m/s, degrees; a heading or bearing is counter-clockwise, in (-180, 180].
-- They are written so that filters on relation and kinds, and on frame_id where a table has it, reach the scans of the tables, and so
-- that joining them with a user's own list of frames stays cheap (static nodes and edges meet the frames as masks of a bucket).

CREATE VIEW main.frames AS
SELECT f.frame_id, f.trace_id, f.seq, f.time_ns, f.ego, t.name AS trace, round((f.time_ns - t.start_ns) / 1e3) / 1e6 AS t, f.log_time_ns, m.name AS map
FROM inside.frame f JOIN inside.trace t ON t.trace_id = f.trace_id LEFT JOIN inside.map m ON m.map_id = f.map_id;

COMMENT ON VIEW main.frames IS 'One row a frame. ego: node_id of the ego, NULL where it is absent; trace: name of the recording; t: seconds since the trace began; log_time_ns: of the leading message; map: name of the road map, NULL without one.';

CREATE VIEW main.nodes AS
SELECT s.frame_id, s.node_id, s.kind, s.is_ego, s.kind || ' ' || s.node_id AS name, s.special, s.subkind, false AS is_static,
       t.origin_x + s.x AS x, t.origin_y + s.y AS y, t.origin_z + s.z AS z,
       degrees(s.heading) AS heading, degrees(s.pitch) AS pitch, degrees(s.roll) AS roll, s.speed, s.vx, s.vy, s.vz,
       s.ax * cos(s.heading) + s.ay * sin(s.heading) AS accel, s.ax, s.ay, s.az, degrees(s.yaw_rate) AS yaw_rate,
       s.length, s.width, s.height, s.light_state,
       (s.lights & 1) <> 0 AS light_left, (s.lights & 2) <> 0 AS light_right, (s.lights & 4) <> 0 AS light_brake,
       (s.lights & 8) <> 0 AS light_reverse, (s.lights & 16) <> 0 AS light_position, (s.lights & 32) <> 0 AS light_low_beam,
       (s.lights & 64) <> 0 AS light_high_beam, (s.lights & 128) <> 0 AS light_fog, (s.lights & 256) <> 0 AS light_interior,
       (s.lights & 512) <> 0 AS light_special1, (s.lights & 1024) <> 0 AS light_special2, s.steer, s.throttle, s.brake, s.gear, s.hand_brake,
       (s.derived & 1) <> 0 AS derived_velocity, (s.derived & 2) <> 0 AS derived_acceleration, (s.derived & 4) <> 0 AS derived_yaw_rate,
       NULL::VARCHAR AS lane_type, NULL::VARCHAR AS road, NULL::INTEGER AS section, NULL::INTEGER AS lane, NULL::VARCHAR AS junction,
       NULL::VARCHAR AS turn, NULL::FLOAT AS speed_limit, NULL::DOUBLE AS curvature, e.ident, e.type_name, s.carrier, e.lifetime, t.name AS trace
FROM inside.state s JOIN inside.entity e ON e.trace_id = s.frame_id >> 24 AND e.node_id = s.node_id JOIN inside.trace t ON t.trace_id = e.trace_id
UNION ALL
SELECT f.frame_id, n.node_id, n.kind, false, n.name, n.special, n.subkind, true, n.x, n.y, n.z, degrees(n.heading),
       NULL, NULL, n.still, n.still, n.still, n.still, NULL, NULL, NULL, NULL, NULL, n.length, n.width, n.height,
       NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL,
       n.lane_type, n.road, n.section, n.lane, n.junction, n.turn, n.speed_limit, n.curvature, n.ident, n.type_name, NULL, n.lifetime, n.trace
FROM inside.frame f JOIN (
  SELECT k.bucket, k.mask, k.node_id, k.kind, m.name, NULL::VARCHAR AS special, NULL::VARCHAR AS subkind, m.x, m.y, m.z, m.heading,
         m.length::FLOAT AS length, m.width::FLOAT AS width, NULL::FLOAT AS height,
         CASE WHEN k.kind IN ('lane', 'road', 'junction', 'crosswalk', 'off_road', 'waypoint', 'roundabout') THEN NULL ELSE 0::FLOAT END AS still, m.lane_type, m.road, m.section, m.lane, m.junction, m.turn, m.speed_limit::FLOAT AS speed_limit, m.curvature,
         NULL::VARCHAR AS ident, NULL::VARCHAR AS type_name, NULL::INTEGER AS lifetime, t.name AS trace
  FROM inside.bucket b JOIN inside.trace t ON t.trace_id = b.trace_id JOIN inside.node k ON k.bucket = b.bucket JOIN inside.map_node m ON m.map_id = b.map_id AND m.node_id = k.node_id
  UNION ALL
  SELECT k.bucket, k.mask, k.node_id, k.kind, k.kind || ' ' || k.node_id, e.special, e.subkind,
         t.origin_x + e.x, t.origin_y + e.y, t.origin_z + e.z, e.heading, e.length, e.width, e.height, 0::FLOAT, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL,
         e.ident, e.type_name, e.lifetime, t.name
  FROM inside.node k JOIN inside.trace t ON t.trace_id = k.bucket >> 18 JOIN inside.entity e ON e.trace_id = t.trace_id AND e.node_id = k.node_id
) n ON n.bucket = f.bucket AND (n.mask & (1::BIGINT << f.bit)) <> 0;

COMMENT ON VIEW main.nodes IS 'One row a node and frame: entities (node_id 0 and above) and parts of the road map in range (below zero). ident, type_name: of an entity, as the simulator has them; x, y, z, length, width, height in m (a lane: a point of its centre line, its length and mean width); heading, pitch, roll in degrees; speed, vx, vy, vz, speed_limit in m/s (what stands for ever has speed 0); accel (signed, along the heading), ax, ay, az in m/s²; yaw_rate in degrees/s; steer -1 … 1, throttle and brake 0 … 1; gear: 1, 2, …, 0 neutral, below 0 backwards; hand_brake: whether it is on; curvature of a waypoint in 1/m, positive to the left. carrier: node_id of what pulls a trailer or carries a rider; lifetime: 1, 2, …: which of the entities with this ident, where an id returns as another entity. What is not known is NULL. derived_…: computed by differences, not read from the recording; trace: name of the recording.';

CREATE VIEW main.edges AS
SELECT f.frame_id, e.src, e.relation, e.dst, e.src_kind, e.dst_kind, e.src_is_ego, e.dst_is_ego, t.name AS trace
FROM inside.frame f JOIN inside.trace t ON t.trace_id = f.trace_id JOIN (
  SELECT bucket, mask, src, relation, dst, src_kind, dst_kind, src_is_ego, dst_is_ego FROM inside.edge
  UNION ALL
  SELECT b.bucket, s.mask & d.mask, m.src, m.relation, m.dst, m.src_kind, m.dst_kind, false, false
  FROM inside.bucket b JOIN inside.node s ON s.bucket = b.bucket JOIN inside.map_edge m ON m.map_id = b.map_id AND m.src = s.node_id
       JOIN inside.node d ON d.bucket = b.bucket AND d.node_id = m.dst
  WHERE (s.mask & d.mask) <> 0
) e ON e.bucket = f.bucket AND (e.mask & (1::BIGINT << f.bit)) <> 0;

COMMENT ON VIEW main.edges IS 'One row an edge and frame: src relation dst. Edges among parts of the road map are among them. For how an entity lies in a lane (relation isIn) join lane_states USING (frame_id, src, dst), for the gap between who follows and who leads lane_gaps. trace: name of the recording.';

CREATE VIEW main.lane_states AS
SELECT f.frame_id, l.node_id AS src, l.lane AS dst, l.kind AS src_kind, l.overlap, l.lane_offset, degrees(l.heading_error) AS heading_error,
       l.is_primary, l.along, l.is_own
FROM inside.frame f JOIN inside.lane_single l ON l.bucket = f.bucket AND l.bit = f.bit
UNION ALL
SELECT f.frame_id, l.node_id, l.lane, l.kind, l.overlap, l.lane_offset, degrees(l.heading_error), l.is_primary, l.along, l.is_own
FROM inside.frame f JOIN inside.lane_repeated l ON l.bucket = f.bucket AND (l.mask & (1::BIGINT << f.bit)) <> 0;

COMMENT ON VIEW main.lane_states IS 'How entities lie in lanes: one row for each edge isIn from an entity (src) to a lane (dst). overlap: share of the footprint in the lane; lane_offset: of the centre, to the left of the lane''s centre line, m; heading_error: heading less the lane''s direction, degrees; is_primary: the one lane of the entity: in a junction the lane that a vehicle drives on its way from entry to exit; along: of the centre along the lane, from its start in its direction, beyond its ends too, m; is_own: a lane of lane_dists and leads: the primary one and, if the driven lane in a junction is not sure, the others that hold the centre and, of a vehicle, have its direction.';

CREATE VIEW main.lane_courses AS
SELECT s.frame_id, s.src AS node_id, s.src_kind AS kind, s.dst AS lane, s.along, c.curvature, c.slope
FROM main.lane_states s JOIN inside.frame f ON f.frame_id = s.frame_id
     JOIN inside.map_course c ON c.map_id = f.map_id AND c.lane = s.dst AND greatest(s.along::DOUBLE, 0) >= c.start
          AND (c."end" IS NULL OR s.along::DOUBLE < c."end")
WHERE s.is_primary;

COMMENT ON VIEW main.lane_courses IS 'How the lane runs where an entity is: one row a frame and entity that is in a lane, of the one that it is in above all. curvature: positive where the lane turns to the left as its traffic sees it, 1/m; slope: rise over run in the direction of the lane, 0.05 is 5 % uphill, NULL where the map has no heights. Both are means over about a metre of the centre line.';

CREATE VIEW main.lane_gaps AS
SELECT f.frame_id, g.src, g.dst, g.gap
FROM inside.frame f JOIN inside.gap_single g ON g.bucket = f.bucket AND g.bit = f.bit
UNION ALL
SELECT f.frame_id, g.src, g.dst, g.gap
FROM inside.frame f JOIN inside.gap_repeated g ON g.bucket = f.bucket AND (g.mask & (1::BIGINT << f.bit)) <> 0;

COMMENT ON VIEW main.lane_gaps IS 'How far it is along the lanes: one row for each edge src follows dst (and dst leads src). gap: from bumper to bumper along the centre lines, m; 0 where they overlap, NULL where a length is not known.';

-- Pairs are not stored: they are functions of two states. Their numbers are declared in sgstore/model/pair_numbers, which also
-- writes the SELECT of this view, with a column for each of them, and what its comment says of them.
CREATE VIEW main.pairs AS {{pairs}};

COMMENT ON VIEW main.pairs IS 'One row for each ordered pair of entities of a graph (within [range] radius of the ego; world_pairs has the others) that move or change (traffic lights change), in the same frame; a is src, b is dst. Without lights: WHERE src_kind <> ''traffic_light'' AND dst_kind <> ''traffic_light''. {{numbers of pairs}}. For how far it is along the lanes LEFT JOIN lane_dists USING (frame_id, src, dst).';

-- As many columns again, whose statement takes the database some time to read.
CREATE VIEW main.criticality AS {{criticality}};

COMMENT ON VIEW main.criticality IS 'The columns of pairs, and measures of how critical it is between src (a) and dst (b), each looking ahead from this frame. {{numbers of criticality}}. NULL also where something that a measure needs is not known.';

-- A view of its own, and no column of pairs: who asks for other numbers should not pay for these joins.
CREATE VIEW main.lane_dists AS
SELECT frame_id, src, dst, CASE WHEN behind IS NULL OR ahead <= -behind THEN ahead ELSE behind END AS lane_dist, src_kind, dst_kind, src_is_ego, dst_is_ego
FROM (
  SELECT frame_id, src, dst, src_kind, dst_kind, src_is_ego, dst_is_ego, min(CASE WHEN way >= 0 THEN way END) AS ahead, max(CASE WHEN way < 0 THEN way END) AS behind
  FROM (
    SELECT f.frame_id, a.node_id AS src, b.node_id AS dst, a.kind AS src_kind, b.kind AS dst_kind, a.is_ego AS src_is_ego, b.is_ego AS dst_is_ego,
        r.start + (b.along::DOUBLE - a.along::DOUBLE) AS way
    FROM inside.frame f JOIN inside.lane_state a ON a.bucket = f.bucket AND a.frame_id = f.frame_id
         JOIN inside.lane_state b ON b.bucket = f.bucket AND b.frame_id = f.frame_id AND b.node_id <> a.node_id
         JOIN inside.map_reach r ON r.map_id = f.map_id AND r.src = a.lane AND r.dst = b.lane
    WHERE a.is_own AND b.is_own
      AND a.kind <> 'traffic_light' AND a.kind <> 'stop_sign' AND a.kind <> 'yield_sign' AND a.kind <> 'speed_limit' AND a.kind <> 'sign'
      AND b.kind <> 'traffic_light' AND b.kind <> 'stop_sign' AND b.kind <> 'yield_sign' AND b.kind <> 'speed_limit' AND b.kind <> 'sign')
  WHERE way BETWEEN -200 AND 200
  GROUP BY ALL);

COMMENT ON VIEW main.lane_dists IS 'How far it is along the lanes: one row for each ordered pair of entities, lights and signs aside, that a way of at most 200 m joins (lane changes are none). lane_dist: from centre to centre, positive where one drives from src to dst, negative where one drives from dst to src; the shorter one counts, m.';

-- The same views of what is known beyond the graphs: the statements of nodes, lane_states and lane_dists over the other tables
-- (store/_schema.py puts them in), and that of pairs over both.

CREATE VIEW main.world_nodes AS
SELECT *, true AS in_graph FROM main.nodes UNION ALL SELECT *, false FROM ({{world_nodes}});

COMMENT ON VIEW main.world_nodes IS 'The columns of nodes, and of what is known beyond the graphs, too: one row a frame and entity, or part of the road map, within [range] world of the ego. in_graph: whether it is in the graph of the frame, so that nodes has the row, too. Edges and classes are of graphs alone.';

CREATE VIEW main.world_lane_states AS
SELECT *, true AS in_graph FROM main.lane_states UNION ALL SELECT *, false FROM ({{world_lane_states}});

COMMENT ON VIEW main.world_lane_states IS 'The columns of lane_states, and how entities beyond the graphs lie in lanes, too. in_graph: whether the entity is in the graph of the frame.';

CREATE VIEW main.world_pairs AS {{world_pairs}};

COMMENT ON VIEW main.world_pairs IS 'The columns of pairs, for each ordered pair of entities that move or change, in the same frame, as world_nodes has them: beyond the graphs, too.';

CREATE VIEW main.world_criticality AS {{world_criticality}};

COMMENT ON VIEW main.world_criticality IS 'The columns of criticality, for each ordered pair of entities that move or change, in the same frame, as world_nodes has them: beyond the graphs, too.';

CREATE VIEW main.world_lane_dists AS {{world_lane_dists}};

COMMENT ON VIEW main.world_lane_dists IS 'The columns of lane_dists, for each ordered pair of entities as world_nodes has them: beyond the graphs, too.';

CREATE VIEW main.classes AS
SELECT f.frame_id, c.abstraction, replace(c.class::VARCHAR, '-', '') AS class
FROM inside.frame f JOIN (SELECT * FROM inside.frame_class UNION ALL SELECT * FROM inside.later_class) c
     ON c.bucket = f.bucket AND (c.mask & (1::BIGINT << f.bit)) <> 0;

COMMENT ON VIEW main.classes IS 'One row a frame and abstraction (E, EL, ER, RSV, junction; others once they were asked for). class: equal exactly where the labelled graphs are the same but for which node is which (isomorphic), in every store; 32 hexadecimal digits, NULL where a graph is so symmetric that it was given up.';

CREATE VIEW main.roles AS
SELECT f.frame_id, r.node_id, r.role
FROM inside.frame f JOIN inside.lane_role r ON r.bucket = f.bucket AND (r.mask & (1::BIGINT << f.bit)) <> 0;

COMMENT ON VIEW main.roles IS 'What lanes are to the ego: one row a frame and lane that is in range or that traffic is in, as far as it can be said. role: Ego Lane; Left 1 of Ego Lane, Right 2 of Ego Lane … for lanes beside it that run the same way; Opposing Lane 0, 1 … for any other that traffic is in, the nearest first. Lanes one behind the other are one and have the same role (as in the abstraction RSV).';

CREATE VIEW main.lanes AS
SELECT m.name AS map, n.node_id, n.name, n.lane_type, n.road, n.section, n.lane, n.junction, n.turn, n.x, n.y, n.z, degrees(n.heading) AS heading,
       n.length, n.width, n.speed_limit::FLOAT AS speed_limit
FROM inside.map_node n JOIN inside.map m ON m.map_id = n.map_id
WHERE n.kind = 'lane';

COMMENT ON VIEW main.lanes IS 'One row a lane of a road map. name: road/section/lane; x, y, z, heading: a point of its centre line and the direction of travel there, m and degrees; width: mean, m; speed_limit: m/s; turn: where a lane in a junction leads. node_id is unique in its map.';

CREATE VIEW main.entities AS
SELECT e.trace_id, e.node_id, e.kind, e.kind || ' ' || e.node_id AS name, e.ident, e.special, e.subkind, e.type_name, e.is_static, e.map_ref,
       t.origin_x + e.x AS x, t.origin_y + e.y AS y, t.origin_z + e.z AS z, degrees(e.heading) AS heading, e.length, e.width, e.height,
       e.parked, e.lifetime, t.name AS trace
FROM inside.entity e JOIN inside.trace t ON t.trace_id = e.trace_id;

COMMENT ON VIEW main.entities IS 'One row an entity of a trace. ident, type_name: as the simulator has them; is_static: it never moves, and its pose is here; map_ref: the OpenDRIVE signal or object that it is, of a signal that the map does not have the names of the lanes that it applies to; parked: whether a vehicle does not move in the whole trace and is never on a lane for driving, or is static in the simulator; lifetime: 1, 2, …: which of the entities with this ident: an id that returns as another kind, or where it cannot have moved, is a new entity; trace: name of the recording.';

CREATE VIEW main.traces AS
SELECT t.name AS trace, t.trace_id, r.uri AS file, t.flavour, t.ego, m.name AS map, t.frames,
       round((CASE WHEN t.end_ns >= t.start_ns THEN t.end_ns - t.start_ns ELSE (t.frames - 1) * abs(t.period_ns) END) / 1e6) / 1e3 AS seconds,
       t.start_ns, t.end_ns, t.since, t.until, coalesce(json_array_length(t.report, '$.losses'), 0) AS losses,
       json_extract(t.report, '$.scope') AS scope, r.digest AS sha256, t.ingested_at, t.version
FROM inside.trace t JOIN inside.recording r ON r.recording_id = t.recording_id LEFT JOIN inside.map m ON m.map_id = t.map_id;

COMMENT ON VIEW main.traces IS 'One row a trace: a recording with one ego. trace: its name in this store; trace_id: equal in every store; file: path of the recording when it was ingested; flavour: the reader, such as osi; ego: as the simulator calls it, NULL without one; map: name of the road map, NULL without one; seconds: duration; start_ns, end_ns: simulation time of the first and the last frame; since, until: the part of the recording that was read, in seconds, NULL for its start and end; losses: number of unreadable parts; scope: states that the settings exclude, as JSON; sha256: of the recording; ingested_at: in UTC; version: of sgstore.';

CREATE VIEW main.payloads AS
SELECT f.frame_id, c.topic AS channel, p.log_time_ns, (p.log_time_ns - f.log_time_ns) / 1e9 AS offset_s, c.schema, r.uri AS file,
       p.chunk_offset, p."offset" AS message_offset, p.length
FROM inside.frame f JOIN inside.payload p ON p.bucket = f.bucket AND p.bit = f.bit
     JOIN inside.channel c ON c.trace_id = f.trace_id AND c.channel_id = p.channel_id JOIN inside.trace t ON t.trace_id = f.trace_id
     JOIN inside.recording r ON r.recording_id = t.recording_id;

COMMENT ON VIEW main.payloads IS 'The message of each channel that belongs to a frame, by its place in the recording. channel: topic; offset_s: log time less the frame''s; chunk_offset: of the chunk in the file, -1 if the message is in none; message_offset: of the message record in the chunk''s records, uncompressed, or in the file; length: of the message''s data, bytes.';

CREATE VIEW main.events AS
SELECT v.frame_id, v.trace_id, t.name AS trace, v.kind, v.time_ns, round((v.time_ns - t.start_ns) / 1e3) / 1e6 AS t, v.log_time_ns,
       e.node_id, o.node_id AS other, v.value, v.detail, v.ident, v.other AS other_ident
FROM inside.event v JOIN inside.trace t ON t.trace_id = v.trace_id
     LEFT JOIN inside.entity e ON e.trace_id = v.trace_id AND e.ident = v.ident AND e.lifetime = v.lifetime
     LEFT JOIN inside.entity o ON o.trace_id = v.trace_id AND o.ident = v.other AND o.lifetime = v.other_lifetime;

COMMENT ON VIEW main.events IS 'What the simulator says has happened. frame_id: of the frame that is nearest in time; kind: collision, lane_invasion, environment; t: seconds since the trace began; node_id, ident: the vehicle, as an entity and as the simulator calls it; other, other_ident: what it collided with, NULL where that is no entity of the trace or nothing; value: length of the impulse of a collision, N·s; detail: markings that were crossed (broken, solid, other), or weather and light from then on. What is not known is NULL.';

CREATE VIEW main.attributes AS
SELECT frame_id, node_id, attribute AS name, json_extract_string(value, '$') AS text, value
FROM inside.attribute WHERE relation IS NULL;

COMMENT ON VIEW main.attributes IS 'Attributes without a column in nodes: one row for each of a node in a frame. They come from imported graphs, and from recordings: control_… (commanded control inputs of a vehicle; steer, throttle, … in nodes are the applied ones), manual_gear, ang_vel_x and ang_vel_y (about the axes of the map, degrees/s). name: as in the file; text: its value as text; value: as JSON.';

CREATE VIEW main.edge_attributes AS
SELECT frame_id, node_id AS src, relation, dst, attribute AS name, json_extract_string(value, '$') AS text, value
FROM inside.attribute WHERE relation IS NOT NULL;

COMMENT ON VIEW main.edge_attributes IS 'The same of edges (src relation dst): one row for each attribute for which no view has a column.';

CREATE VIEW main.imports AS
SELECT f.frame_id, i.graph, i.place, i.images
FROM inside.frame f JOIN inside.imported i ON i.bucket = f.bucket AND i.bit = f.bit;

COMMENT ON VIEW main.imports IS 'One row a frame that was imported as a graph. graph: what its file calls it; place: row or line of the file where it begins; images: how many frames of the source it stands for (S3C keeps one for each class), else 1.';
