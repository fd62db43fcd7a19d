"""Clients of policy servers, one module per protocol."""
