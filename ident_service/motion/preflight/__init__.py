"""Every check between an arm that stands on its support and one that may move: what they find is a ticket."""
