//! Every right form once, and every wrong one with where it is wrong.

use super::*;

fn good(text: &str) -> Endpoint {
    text.parse().unwrap_or_else(|error: EndpointError| panic!("{error}"))
}

/// The text is refused, with this part pointed at, and these words said about it.
#[track_caller]
fn bad(text: &str, part: &str, start: usize, words: &str) {
    let error = text.parse::<Endpoint>().expect_err("it should be refused");
    assert_eq!((error.part(), error.at().start), (part, start), "{error}");
    let said = error.problem();
    assert!(said.contains(words), "{words:?} is not said in {said:?}");
}

#[test]
fn a_medium_that_was_left_out_is_told_with_the_feature_that_it_needs() {
    let known: [media::KnownMedium; 2] = [("udp", "ip", false), ("memory", "", true)];
    assert_eq!(media::find(&known, "memory"), Ok("memory"));
    let left_out = media::find(&known, "udp").unwrap_err();
    assert!(left_out.contains("without `udp`: add the feature `ip`"), "{left_out}");
    let unknown = media::find(&known, "udq").unwrap_err();
    assert!(unknown.ends_with("`udq`: there is memory alone"), "{unknown}");
}

#[test]
fn udp_is_read_with_all_its_settings() {
    let Endpoint::Udp(plain) = good("udp://0.0.0.0:7400") else { panic!() };
    assert_eq!((plain.bind, plain.group), ("0.0.0.0:7400".parse().unwrap(), None));

    let Endpoint::Udp(config) = good(
        "udp://[fd00::1]:0?interface=firewire0&mtu=1400&receive_buffer=65536&send_buffer=8192\
         &queue_frames=9",
    ) else {
        panic!()
    };
    assert_eq!(config.bind, "[fd00::1]:0".parse().unwrap());
    assert_eq!((config.interface.as_deref(), config.mtu), (Some("firewire0"), Some(1400)));
    let buffers = (config.receive_buffer, config.send_buffer, config.queue_frames);
    assert_eq!(buffers, (65_536, 8_192, 9));
}

#[test]
fn a_multicast_address_is_a_group_to_hear_and_our_own_port_is_another() {
    let Endpoint::Udp(config) =
        good("udp://239.255.0.1:7400?interface=eth0&own=0.0.0.0:7401&hops=4")
    else {
        panic!()
    };

    assert_eq!(config.group, Some("239.255.0.1:7400".parse().unwrap()));
    assert_eq!((config.bind, config.hops), ("0.0.0.0:7401".parse().unwrap(), 4));
    let Endpoint::Udp(six) = good("udp://[ff15::1]:7400") else { panic!() };
    assert_eq!(six.bind, "[::]:0".parse().unwrap());
}

#[test]
fn tcp_is_read_with_all_its_settings() {
    let Endpoint::Tcp(config) = good(
        "tcp://127.0.0.1:7400?interface=lo&mtu=9000&peers=3&strangers=4&queue_bytes=5000\
         &connect_timeout=1500ms&hello_timeout=2s&user_timeout=900000us",
    ) else {
        panic!()
    };

    assert_eq!(config.bind, "127.0.0.1:7400".parse().unwrap());
    assert_eq!(config.interface.as_deref(), Some("lo"));
    let StreamLimits { mtu, peers, strangers, queue_bytes, .. } = config.limits;
    assert_eq!((mtu, peers, strangers, queue_bytes), (9_000, 3, 4, 5_000));
    let StreamLimits { connect_timeout, hello_timeout, .. } = config.limits;
    let times = [connect_timeout, hello_timeout, config.user_timeout];
    assert_eq!(times.map(|time| time.as_millis()), [1_500, 2_000, 900]);
}

#[test]
fn unix_sockets_are_read_with_all_their_settings() {
    let Endpoint::Unix(config) = good(
        "unix:///run/a b.sock?mode=660&mtu=9000&peers=3&strangers=4&queue_bytes=5000\
         &connect_timeout=1s&hello_timeout=3s",
    ) else {
        panic!()
    };

    assert_eq!(config.path, PathBuf::from("/run/a b.sock"));
    let StreamLimits { mtu, peers, strangers, queue_bytes, .. } = config.limits;
    assert_eq!((config.mode, mtu, peers), (0o660, 9_000, 3));
    assert_eq!((strangers, queue_bytes), (4, 5_000));
    let StreamLimits { connect_timeout, hello_timeout, .. } = config.limits;
    assert_eq!((connect_timeout.as_secs(), hello_timeout.as_secs()), (1, 3));
}

#[test]
fn serial_lines_are_read_with_all_their_settings() {
    let Endpoint::Serial(config) = good(
        "serial:///dev/ttyUSB0?baud=921600&parity=even&stop_bits=2&flow=hardware&mtu=700\
         &queue_time=50ms",
    ) else {
        panic!()
    };

    assert_eq!((config.path, config.baud), (PathBuf::from("/dev/ttyUSB0"), Some(921_600)));
    assert_eq!((config.parity, config.stop_bits), (Parity::Even, StopBits::Two));
    assert_eq!((config.hardware_flow, config.mtu), (true, Some(700)));
    assert_eq!((config.queue_time, config.rs485), (Duration::from_millis(50), None));

    let turned = "serial:///dev/ttyS0?rs485=true&rts=low&rts_before=1ms&rts_after=2ms";
    let Endpoint::Serial(config) = good(turned) else { panic!() };
    let how = config.rs485.expect("it was asked for");
    let times = (how.before, how.after);
    assert_eq!((how.rts_low, times), (true, (Duration::from_millis(1), Duration::from_millis(2))));

    let Endpoint::Serial(config) = good("serial:///dev/ttyS0?rs485=false") else { panic!() };
    assert_eq!(config.rs485, None);
}

#[test]
fn can_is_read_with_all_its_settings() {
    let Endpoint::Can(plain) = good("can://can0?fd=true") else { panic!() };
    assert_eq!((plain.interface.as_str(), plain.fd, plain.bit_rate_switch), ("can0", true, false));
    assert_eq!(plain.node, CanNodeConfig::default());

    let Endpoint::Can(config) = good(
        "can://vcan1?fd=true&bit_rate_switch=true&address=7&mtu=800&queue_frames=8&block_size=4\
         &separation=200us",
    ) else {
        panic!()
    };
    assert!(config.bit_rate_switch);
    let CanNodeConfig { address, mtu, queue_frames, block_size, separation, .. } = config.node;
    assert_eq!((address, mtu, queue_frames, block_size), (7, 800, 8, 4));
    assert_eq!(separation, Duration::from_micros(200));
}

#[test]
fn can_adapters_are_read_with_all_their_settings() {
    let Endpoint::Slcan(config) =
        good("slcan:///dev/ttyACM0?bitrate=125000&baud=3000000&address=9&separation=5ms")
    else {
        panic!()
    };

    assert_eq!((config.path, config.bitrate), (PathBuf::from("/dev/ttyACM0"), 125_000));
    assert_eq!((config.baud, config.node.address), (3_000_000, 9));
    assert!(!config.fd);
    assert_eq!(config.node.separation, Duration::from_millis(5));
}

#[test]
fn can_adapters_with_can_fd_have_a_second_rate_and_others_none() {
    let Endpoint::Slcan(config) =
        good("slcan:///dev/ttyACM0?fd=true&bit_rate_switch=true&data_bitrate=5000000")
    else {
        panic!()
    };
    assert_eq!((config.fd, config.bit_rate_switch, config.data_bitrate), (true, true, 5_000_000));

    for wrong in ["data_bitrate=2000000", "bit_rate_switch=true", "fd=true&data_bitrate=8000000"] {
        let error = format!("slcan:///dev/ttyACM0?{wrong}").parse::<Endpoint>();
        assert!(error.is_err(), "{wrong}");
    }
}

#[test]
fn an_end_in_memory_has_a_name() {
    let Endpoint::Memory(name) = good("memory://left") else { panic!() };
    assert_eq!(name, "left");
}

#[test]
fn a_medium_that_is_missing_or_unknown_is_pointed_at() {
    bad("0.0.0.0:7400", "", 0, "begins with its medium");
    bad("", "", 0, "begins with its medium");
    bad("upd://0.0.0.0:7400", "upd", 0, "did you mean `udp`?");
    let known = "there are udp, tcp, unix, serial, can, slcan, memory";
    bad("zigbee://x", "zigbee", 0, known);
}

#[test]
fn the_name_of_a_host_is_found_and_an_error_beside_it_is_shown_in_the_text_with_it() {
    let address = "[fd00::1]:7400".parse().expect("an address");
    let found = |text: &str| NamedHost::find(text).map(|named| named.name().to_owned());
    for text in ["udp://10.0.0.1:7400", "[fd00::1]:7400", "unix:///run/a:1", "ro!bot:1", "a..b:1"] {
        assert_eq!(found(text), None);
    }
    for text in ["arm.local:7400", "arm-1:0", "tcp://arm.local.:7400?mtu=1400"] {
        assert!(found(text).is_some(), "{text}");
    }

    let named = NamedHost::find("udp://arm.local:7400?buad=1").expect("a name");
    let error = named.parse(address).expect_err("no such setting");
    assert_eq!((error.part(), error.at().start), ("buad", 21));
    assert!(error.to_string().contains("udp://arm.local:7400?buad=1"), "{error}");
    let (endpoint, _) = NamedHost::find("udp://arm:7400").unwrap().parse(address).unwrap();
    assert_eq!(endpoint.to_string(), "udp://[fd00::1]:7400");
}

#[test]
fn a_wrong_ip_address_is_pointed_at() {
    bad("udp://0.0.0:7400", "0.0.0:7400", 6, "no address");
    bad("tcp://localhost:7400", "localhost:7400", 6, "no address with a port");
    bad("tcp://robot", "robot", 6, "as in 10.0.0.1:7400, [fd00::1]:7400 or robot.local:7400");
    bad("udp://10.0.0.1", "10.0.0.1", 6, "the port is missing: write 10.0.0.1:7400");
    bad("udp://[fd00::1]", "[fd00::1]", 6, "no address with a port");
    bad("udp://fd00::1", "fd00::1", 6, "write [fd00::1]:7400");
    bad("udp://255.255.255.255:1", "255.255.255.255:1", 6, "the address of many");
    bad("tcp://255.255.255.255:1", "255.255.255.255:1", 6, "the address of many");
    bad("udp://10.0.0.1:74000", "10.0.0.1:74000", 6, "a port of 0 to 65535");
    bad("udp://10.0.0.1:?mtu=100", "10.0.0.1:", 6, "no address with a port");
    bad("udp://", "", 6, "no address with a port");
    bad("udp://239.255.0.1:0", "239.255.0.1:0", 6, "has no port");
    bad("tcp://239.255.0.1:7400", "239.255.0.1:7400", 6, "such as udp://239.255.0.1:7400");
}

#[test]
fn an_address_that_is_everybodys_is_none_of_our_own() {
    bad("udp://224.0.0.1:7400", "224.0.0.1:7400", 6, "as in 239.255.0.1:7400");
    bad("udp://224.0.0.251:5353", "224.0.0.251:5353", 6, "the network's own protocols");
    bad("udp://[ff02::1]:7400", "[ff02::1]:7400", 6, "or [ff15::1]:7400");
    good("udp://224.0.1.1:7400");
    let own = "udp://239.0.0.1:1?own=255.255.255.255:7401";
    bad(own, "255.255.255.255:7401", 22, "our own address");

    // What did not come as a text is checked as well.
    let check = |bind: &str| {
        let bind = bind.parse().unwrap();
        let udp = Endpoint::Udp(UdpConfig { bind, ..UdpConfig::default() }).check();
        assert_eq!(udp, Endpoint::Tcp(TcpConfig { bind, ..TcpConfig::default() }).check());
        udp
    };
    for wrong in ["224.0.0.1:7400", "239.255.0.1:7400", "[ff15::1]:7400", "255.255.255.255:7400"] {
        let text = check(wrong).expect_err(wrong);
        assert!(text.contains(wrong) && text.contains("the address of many"), "{text}");
    }
    for right in ["0.0.0.0:0", "127.0.0.1:7400", "[::]:7400"] {
        assert_eq!(check(right), Ok(()));
    }
}

#[test]
fn a_wrong_path_or_name_is_pointed_at() {
    bad("unix://run/x.sock", "run/x.sock", 7, "begins with a slash, as in unix:///run/robot.sock");
    bad("serial://", "", 9, "as in serial:///dev/ttyUSB0");
    bad("slcan://ttyACM0", "ttyACM0", 8, "as in slcan:///dev/ttyACM0");
    bad("unix:///run/a\0", "/run/a\0", 7, "begins with a slash");
    let long = format!("/{}", "x".repeat(107));
    bad(&format!("unix://{long}"), &long, 7, "108 bytes, and a socket's has at most 107");
    good(&format!("unix://{}", &long[..107]));
    bad("can://", "", 6, "the name of an interface is missing, as in can://can0");
    bad("can://a/b", "a/b", 6, "the name of an interface");
    bad("memory://", "", 9, "our own end of the memory medium has no name");
}

#[test]
fn a_wrong_setting_is_pointed_at() {
    bad("serial:///dev/ttyS0?buad=9600", "buad", 20, "did you mean `baud`?");
    bad("memory://left?mtu=9", "mtu", 14, "memory has no key `mtu`: there is insecure alone");
    bad("udp://0.0.0.0:1?hops=3", "hops", 16, "there are interface, mtu,");
    bad("udp://0.0.0.0:1?mtu=999&mtu=998", "mtu", 24, "said twice");
    bad("udp://0.0.0.0:1?mtu", "mtu", 16, "write mtu=…");
    bad("udp://0.0.0.0:1?mtu=", "mtu", 16, "no value");
    bad("udp://0.0.0.0:1?insecure=1", "1", 25, "true or false");
    bad("udp://0.0.0.0:1?insecure&insecure=true", "insecure", 25, "said twice");
    bad("udp://0.0.0.0:1?insecur", "insecur", 16, "did you mean `insecure`?");
    bad("unix:///run/a?users=me", "me", 20, "numbers of users, as in 1001,1002");
    bad("unix:///run/a?users=1,", "1,", 20, "numbers of users, as in 1001,1002");
    bad("udp://0.0.0.0:1?", "", 16, "the name of a setting is missing");
    bad("udp://0.0.0.0:1?mtu=999&&hops=1", "", 24, "the name of a setting is missing");
}

#[test]
fn a_wrong_value_is_pointed_at_with_what_it_may_be() {
    bad("serial:///dev/x?rts_after=1ms", "rts_after", 16, "add rs485=true");
    bad("serial:///dev/x?rs485=false&rts=low", "rts", 28, "add rs485=true");
    let parts = "serial:///dev/x?rs485=true&rts_before=500us";
    bad(parts, "500us", 38, "whole milliseconds");
    bad("serial:///dev/x?rs485=true&flow=hardware", "flow", 27, "leave flow out");
    bad("udp://0.0.0.0:1?mtu=big", "big", 20, "a whole number from 96 to 65507");
    bad("udp://0.0.0.0:1?mtu=95", "95", 20, "from 96");
    bad("udp://0.0.0.0:1?mtu=65508", "65508", 20, "from 96 to 65507");
    bad("udp://0.0.0.0:1?interface=sixteen_letters_", "sixteen_letters_", 26, "of an interface");
    bad("udp://239.0.0.1:1?own=[::1]:1", "[::1]:1", 22, "as in 0.0.0.0:7401");
    bad("tcp://0.0.0.0:1?user_timeout=5", "5", 29, "as in 500ms or 2s");
    bad("tcp://0.0.0.0:1?user_timeout=5min", "5min", 29, "a time from 1ms to 3600s");
    bad("tcp://0.0.0.0:1?user_timeout=0s", "0s", 29, "a time from 1ms");
    bad("unix:///x?mode=888", "888", 15, "octal");
    bad("serial:///dev/ttyS0?parity=evne", "evne", 27, "none, odd, even");
    bad("serial:///dev/ttyS0?flow=xon", "xon", 25, "none, hardware");
    bad("serial:///dev/ttyS0?baud=0", "0", 25, "from 50 to");
    bad("can://can0?fd=yes", "yes", 14, "true or false");
    bad("can://can0?address=256", "256", 19, "from 0 to 254");
    bad("slcan:///dev/ttyACM0?bitrate=300000", "300000", 29, "250000, 500000");
}

#[test]
fn settings_that_exclude_each_other_are_pointed_at() {
    bad("can://can0?bit_rate_switch=true", "bit_rate_switch", 11, "add fd=true");
    bad("can://can0?separation=150us", "150us", 22, "in steps of 100");
    bad("can://can0?separation=1500us", "1500us", 22, "1ms to 127ms");
}

#[test]
fn peers_are_read_as_their_medium_writes_them() {
    let peer = |endpoint: &str, peer: &str| good(endpoint).peer(peer).map_err(|e| e.to_string());
    let address = "10.0.0.2:7400".parse().unwrap();

    assert_eq!(peer("udp://0.0.0.0:0", "10.0.0.2:7400"), Ok(MediumAddress::Ip(address)));
    assert_eq!(peer("tcp://0.0.0.0:0", "10.0.0.2:7400"), Ok(MediumAddress::Ip(address)));
    let path = PathBuf::from("/run/b.sock").into();
    assert_eq!(peer("unix:///run/a.sock", "/run/b.sock"), Ok(MediumAddress::Unix(path)));
    assert_eq!(peer("serial:///dev/ttyS0", ""), Ok(MediumAddress::Line));
    assert_eq!(peer("can://can0", "7"), Ok(MediumAddress::Can(7)));
    assert_eq!(peer("slcan:///dev/ttyS0", "31"), Ok(MediumAddress::Can(31)));
    assert_eq!(peer("memory://a", "b"), Ok(MediumAddress::Memory("b".into())));

    let refused = |endpoint: &str, text: &str, part: &str, words: &str| {
        let error = good(endpoint).peer(text).unwrap_err();
        assert_eq!(error.part(), part);
        assert!(error.to_string().contains(words), "{error}");
    };
    refused("udp://0.0.0.0:0", "10.0.0.2", "10.0.0.2", "the port is missing");
    refused("unix:///run/a.sock", "b.sock", "b.sock", "begins with a slash, as in /run/b.sock");
    refused("serial:///dev/ttyS0", "x", "x", "leave it empty");
    refused("can://can0", "300", "300", "0 to 255");
    refused("memory://a", "", "", "the name of its end");
}

#[test]
fn an_address_that_no_neighbour_can_have_is_refused() {
    let check = |endpoint: &str, peer: &str, words: &str| {
        let error = good(endpoint).peer(peer).expect_err(peer);
        assert_eq!(error.part(), peer);
        assert!(error.to_string().contains(words), "{error}");
    };
    for medium in ["udp", "tcp"] {
        let at = |place: &str| format!("{medium}://{place}");
        check(&at("10.0.0.1:0"), "10.0.0.2:0", "no address of one neighbour");
        check(&at("10.0.0.1:0"), "0.0.0.0:7400", "no address of one neighbour");
        check(&at("[fd00::1]:0"), "[::]:7400", "no address of one neighbour");
        check(&at("10.0.0.1:0"), "255.255.255.255:7400", "no address of one neighbour");
        check(&at("10.0.0.1:0"), "224.0.0.1:7400", "no address of one neighbour");
        check(&at("10.0.0.1:0"), "239.255.0.1:7400", "no address of one neighbour");
        check(&at("[fd00::1]:0"), "[ff15::1]:7400", "no address of one neighbour");
        check(&at("10.0.0.1:7400"), "10.0.0.1:7400", "our own address");
        check(&at("0.0.0.0:7400"), "127.0.0.1:7400", "our own address");
        assert!(good(&at("0.0.0.0:7400")).peer("127.0.0.1:7401").is_ok());
        assert!(good(&at("10.0.0.1:7400")).peer("10.0.0.2:7400").is_ok());
    }
    check("unix:///run/a.sock", "/run/a.sock", "our own address");
    check("unix:///run/a.sock", &format!("/{}", "x".repeat(107)), "at most 107");
    check("can://can0?address=7", "7", "our own address");
    check("memory://a", "a", "our own address");
    check("udp://239.255.0.1:7400", "239.255.0.2:7400", "no address of one neighbour");
    assert!(good("udp://239.255.0.1:7400").peer("239.255.0.1:7400").is_ok(), "the group itself");
    let stranger = MediumAddress::Ip("10.0.0.2:7400".parse().unwrap());
    for medium in ["unix:///run/a.sock", "serial:///dev/ttyS0", "can://can0"] {
        let why = good(medium).objection(&stranger).expect(medium);
        assert!(why.contains("another medium"), "{medium}: {why}");
    }
    assert_eq!(good("serial:///dev/ttyS0").objection(&MediumAddress::Line), None);
}

#[test]
fn the_caret_stands_under_the_wrong_part_whatever_letters_stand_before() {
    let error = "unix:///run/größe\t.sock?mod=660".parse::<Endpoint>().unwrap_err();

    let text = error.to_string();
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 3, "{text}");
    let column = lines[1].chars().position(|c| c == '?').unwrap() + 1;
    assert_eq!(lines[2], format!("{}^^^", " ".repeat(column)));
}

#[test]
fn an_error_has_three_lines_even_where_the_wrong_part_has_several() {
    let error = "serial:///dev/ttyUSB0?ba\nd=9600".parse::<Endpoint>().unwrap_err();

    assert_eq!(error.part(), "ba\nd");
    assert_eq!(error.to_string().lines().count(), 3, "{error}");
}

#[test]
fn no_text_makes_the_parser_panic() {
    use blastema_core::random::Random;
    let pieces = [
        "udp",
        "tcp",
        "unix",
        "serial",
        "can",
        "slcan",
        "memory",
        "://",
        ":",
        "/",
        "?",
        "&",
        "=",
        "[",
        "]",
        "mtu",
        "baud",
        "9",
        "ü",
        "0.0.0.0",
        "\0",
        "separation",
        "us",
        "",
    ];
    for seed in 0..20_000 {
        let mut random = Random::new(seed);
        let length = random.next() % 12;
        let text: String =
            (0..length).map(|_| pieces[random.next() as usize % pieces.len()]).collect();
        if let Err(error) = text.parse::<Endpoint>() {
            assert!(error.to_string().lines().count() == 3, "{text:?}: {error}");
        }
    }
}
