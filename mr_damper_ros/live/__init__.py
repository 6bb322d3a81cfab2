"""What a running system shows of itself: a record of the newest, and the page that displays it."""
