"""SitSofa: walk round the cartons and sit down."""
