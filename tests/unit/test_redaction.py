"""No message shows what an address carries of passwords and signatures."""

import pytest

from sceneloom.errors import redacted


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("https://me:pass@host/a.sfs", "https://***@host/a.sfs"),
        ("https://me:p@ss@host/a@b.sfs", "https://***@host/a@b.sfs"),
        ("https://token@host/a.sfs", "https://***@host/a.sfs"),
        ("s3://bucket/a@b.sfs?versionId=3", "s3://bucket/a@b.sfs?versionId=3"),
        (
            "https://b.s3/a.sfs?X-Amz-Algorithm=A&X-Amz-Credential=AKIA%2F1&X-Amz-Signature=ab12&x=1",
            "https://b.s3/a.sfs?X-Amz-Algorithm=***&X-Amz-Credential=***&X-Amz-Signature=***&x=1",
        ),
        ("https://h/a?sv=2024&sig=a%2Bb%3D&name=n", "https://h/a?sv=***&sig=***&name=n"),
        ("https://h/a?X-Goog-Signature=ff,", "https://h/a?X-Goog-Signature=***,"),
        (
            "https://h/a?AWSAccessKeyId=AK&Signature=s/+=&Expires=9",
            "https://h/a?AWSAccessKeyId=***&Signature=***&Expires=***",
        ),
        ("https://h/a?access_token=x&api-key=y&API_KEY=z", "https://h/a?access_token=***&api-key=***&API_KEY=***"),
        ("503, message='no', url='https://u:p@h/a?sig=s'", "503, message='no', url='https://***@h/a?sig=***'"),
        ("{'Authorization': 'Bearer abc.def', 'x': 1}", "{'Authorization': '***', 'x': 1}"),
        ("AccountName=n;AccountKey=k==;X=1", "AccountName=n;AccountKey=***;X=1"),
        ("a.sfs: sensors[3]: expected a list", "a.sfs: sensors[3]: expected a list"),
        ("who@host/a.sfs", "who@host/a.sfs"),
        ("https://h/a.sfs?design=1&size=2", "https://h/a.sfs?design=1&size=2"),
    ],
)
def test_secrets_are_left_out_and_the_rest_stands(text, expected):
    assert redacted(text) == expected


def test_what_is_redacted_stays_as_it_is_when_redacted_again():
    once = redacted("https://u:p@h/a?X-Amz-Signature=s&sig=t")
    assert redacted(once) == once
