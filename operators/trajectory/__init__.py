"""From measurements of any sensor at any time to one connected trajectory."""
