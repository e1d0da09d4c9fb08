"""What can be done to a map: plain functions from maps to maps, reports and files."""
