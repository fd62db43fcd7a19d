"""A person decides: sources of actions (a browser page, a Redis server) and the session that runs a world with them."""
