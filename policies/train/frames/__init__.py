"""Rows and pictures of datasets on the device: decoded once, batched, transformed."""
