"""The live page: a record of the newest data of a running system, and its web server."""
