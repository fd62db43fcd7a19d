"""Measurements of audits: what they find in forged folders, and what they say of honest ones."""
