"""Commands that check, pack and publish results."""
