"""What is signed, hashed and stored: boards, submissions, results and keys."""
