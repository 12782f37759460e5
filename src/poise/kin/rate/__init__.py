"""The frame rate that a motion has by physics: three kinds of evidence, and a judgement."""
