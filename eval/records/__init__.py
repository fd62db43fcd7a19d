"""Records of evaluation as they are stored: journal line, run document, identity, shards; read and checked."""
