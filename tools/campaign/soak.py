from tools.campaign.case import Case


def cases() -> list[Case]:
    return []
