"""What tests have in common. What a test tests it imports from its module."""
