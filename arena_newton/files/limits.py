"""Limits on reading files of others: one table of limits, each with its reason.

A limit is some ten times what a real file needs, and small enough that reading up to it stays below 1 GiB of memory.
Whoever needs more changes the number here.
"""

MIB = 2**20

# Scenes
LAYERS = 256
"""Layers and images of a scene. The project's own consist of 10; each is opened twice."""
PRIMS = 50_000
"""Prims of a scene, counted through every reference before USD composes them: 30 small files that name each other twice
make 2^30. The project's own scenes count 1,000; USD needs some 10 kB per prim, and Newton more."""
NESTING = 100
"""Deepest prim: USD and the importer recurse once per level."""
ARC_DEPTH = 100
"""Longest chain of references."""
TEXT_BYTES = 64 * MIB
"""Size of a `.usda` layer."""
TEXT_LINES = 500_000
"""Lines of a `.usda` layer: a line can be a prim or an attribute, and USD keeps 400 bytes of each."""
TEXT_NUMBERS = 4_000_000
"""Commas of a `.usda` layer: while USD parses a list it keeps 110 bytes of each element. Larger meshes fit `.usdc`."""
CRATE_BYTES = 128 * MIB
"""Size of a binary layer (`.usdc`)."""
CRATE_MEMORY = 512 * MIB
"""Memory that a binary layer may take: its arrays are compressed, and a damaged one asks for any size."""
CRATE_SECONDS = 20.0
"""Time that a binary layer may take to be read [s]; 100 MiB take one."""
MESH_POINTS = 500_000
"""Points, and corners of faces, of one mesh: hull, normals and ray tree take 600 bytes per point."""
SCENE_POINTS = 1_000_000
"""Points of all meshes of a scene."""
VARIANTS = 32
"""Variants of the set `semantics`: each is composed and judged. The project's own scenes have 2 or 3."""
IMAGE_BYTES = 64 * MIB
"""Size of an image file."""
IMAGE_PIXELS = 4096 * 4096
"""Pixels of an image: 64 MiB in memory. The project's own textures have 256 x 256."""
SCENE_PIXELS = 4 * IMAGE_PIXELS
"""Pixels of all images of a scene."""
ARCHIVE_MEMBERS = 1000
"""Members of a `.usdz` or `.npz` archive."""
FARTHEST = 1000.0
"""Farthest of a prim from the origin, and largest extent [m]: single precision resolves 0.1 mm there."""
PENETRATION = 0.01
"""Depth [m] from which two things that start inside each other are named."""

# Motions and recordings
ARRAY_BYTES = 256 * MIB
"""Arrays of an `.npz` file: 9 hours of motion at 50 Hz. A larger file may hold `ARRAY_GROWTH` times its own size."""
ARRAY_GROWTH = 4
"""Largest growth of an archive when it is read; compressed motions grow by less than 2, zeros by 1000."""
HEADER_BYTES = 10_000
"""Header of an array: type and shape. NumPy's own limit."""
PICKLE_BYTES = 256 * MIB
"""Size of a pickle, and what its arrays may hold: instructions of a few bytes repeat or invent arrays of any size."""
ROWS_MEMORY = 512 * MIB
"""Memory that the rows of a table of a dataset (`.parquet`) may take: 20 hours of states and actions at 50 Hz. Columns
of equal numbers take next to none in the file."""
TABLE_BYTES = 64 * MIB
"""Size of a table (`.csv`): 3 hours at 30 frames per second."""

# Networks
NETWORK_BYTES = 512 * MIB
"""Size of a weights file; the official trackers have 3 to 60 MB."""
NETWORK_LAYERS = 64
"""Layers of a network of our own; they have 4."""
NETWORK_MEMORY = 1024 * MIB
"""Memory that a network may take in onnxruntime beyond the library, its weights twice included."""
NETWORK_SECONDS = 20.0
"""Time that it may take to load and to answer two rows [s]; the official ones take 0.2."""
NETWORK_NODES = 10_000
"""Nodes of an ONNX graph; the official trackers have 200."""
NETWORK_NUMBERS = 2**26
"""Numbers that an ONNX graph may make of 7 rows while it is read, weights aside: 256 MiB. A sum of a column and a row,
or a list joined to itself thirty times, makes any number of a small file."""
