//! The C header of a device's firmware.

use super::port::DevicePort;
use super::{DeviceProxy, DeviceSpec};
use blastema_core::LayoutDescription;
use blastema_core::contract::layout::{Fields, Primitive, Shape};
use blastema_lite::PortKind;
use serde::{Deserialize, Serialize};
use std::fmt::Write;

/// No packed type is nested deeper.
const DEPTH_MAX: usize = 32;

/// Names that C has taken, of those that a field may have in Rust.
const KEYWORDS: [&str; 16] = [
    "auto", "case", "char", "default", "double", "float", "goto", "int", "long", "register",
    "short", "signed", "sizeof", "switch", "unsigned", "void",
];

/// A device as data: what the C header of its firmware is generated from. From
/// [`DeviceSpec::describe`], or a file.
///
/// ```
/// use blastema::prelude::*;
/// use blastema::{DeviceDescription, DeviceSpec};
///
/// #[derive(Clone, Debug, Event)]
/// #[contract(name = "gripper/close")]
/// struct Close {
///     #[contract(unit = "N")]
///     force: f32,
/// }
///
/// let gripper = DeviceSpec::new("gripper", "serial:///dev/ttyUSB0", 0x6772_6970);
/// let json = gripper.accepts::<Close>(0).describe().expect("the spec is right").to_json();
/// // `blastema device header FILE` does the same.
/// let header = DeviceDescription::from_json(&json).expect("a description").header();
/// assert!(header.contains("    float force; /* N */"));
/// assert!(header.contains("#define GRIPPER_CLOSE_IN0(data_) {.object = 1, .id = BL_IN + 0"));
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DeviceDescription {
    name: String,
    device_type: u32,
    ports: Vec<DescribedPort>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct DescribedPort {
    contract: String,
    #[serde(with = "DevicePortKind")]
    direction: PortKind,
    object: u8,
    number: u8,
    size: u8,
    reply_size: u8,
    fingerprint: u32,
    message: LayoutDescription,
    reply: LayoutDescription,
}

/// The names of [`PortKind`] in a description.
#[derive(Serialize, Deserialize)]
#[serde(remote = "PortKind", rename_all = "snake_case")]
enum DevicePortKind {
    In,
    Out,
    Call,
    Variable,
}

impl DescribedPort {
    fn of(port: &DevicePort<DeviceProxy>) -> Self {
        let direction = port.port.kind();
        DescribedPort {
            contract: port.contract.to_owned(),
            direction,
            object: port.port.object(),
            number: port.port.id() & if direction == PortKind::Call { 0x3f } else { 0x1f },
            size: port.port.size(),
            reply_size: port.port.reply(),
            fingerprint: port.port.fingerprint(),
            message: LayoutDescription::of((port.message)()),
            reply: LayoutDescription::of((port.reply)()),
        }
    }

    /// As in the library's names: `BL_IN`.
    fn kind(&self) -> String {
        format!("{:?}", self.direction).to_uppercase()
    }

    /// `GRIPPER_CLOSE_IN0`: the contract, the direction and the number.
    fn name(&self) -> String {
        let object = match self.object {
            1 => String::new(),
            object => format!("{object}_"),
        };
        let contract = identifier(&self.contract).to_uppercase();
        format!("{contract}_{object}{}{}", self.kind(), self.number)
    }
}

impl DeviceSpec {
    /// The device as data, for tools.
    ///
    /// # Errors
    /// The spec is wrong; the text says how.
    pub fn describe(&self) -> Result<DeviceDescription, String> {
        let problem = self.problem.as_ref().map(|(_, why)| why).or(self.medium.as_ref().err());
        if let Some(problem) = problem {
            return Err(problem.clone());
        }
        let (name, device_type) = (self.name.clone(), self.host.device_type);
        let ports = self.ports.iter().map(DescribedPort::of).collect();
        Ok(DeviceDescription { name, device_type, ports })
    }

    /// The C header of the firmware; see [`DeviceDescription::header`].
    ///
    /// # Errors
    /// The spec is wrong; the text says how.
    pub fn header(&self) -> Result<String, String> {
        Ok(self.describe()?.header())
    }
}

impl DeviceDescription {
    /// Reads a description.
    ///
    /// # Errors
    /// The text is no description of a device.
    pub fn from_json(text: &str) -> Result<Self, String> {
        serde_json::from_str(text).map_err(|error| {
            format!("{error}: write the file by `DeviceSpec::describe` and `to_json`")
        })
    }

    /// The description as one JSON document.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("names, numbers and lists are JSON")
    }

    fn objects(&self) -> u8 {
        self.ports.iter().map(|port| port.object).max().unwrap_or(1)
    }

    /// The C header of the firmware: sizes for the library in `core/lite/c`, structs, fingerprints.
    /// The firmware is compiled with `-DBL_CONFIG='"gripper.h"'`, and lists `GRIPPER_PORTS` of its
    /// ports in the order in which they were declared here.
    pub fn header(&self) -> String {
        let guard = identifier(&self.name).to_uppercase();
        let (ports, objects) = (&self.ports, self.objects());
        let largest = ports.iter().map(|port| port.size.max(port.reply_size)).max();
        let data = largest.unwrap_or(0).saturating_add(1).max(objects.saturating_add(10)).max(24);
        let mut text = format!(
            "/* The device `{}`: generated from the contracts of the robot. */\n\
             #ifndef {guard}_H\n#define {guard}_H\n\n#include <stdint.h>\n\n\
             #define BL_MAX_DATA {data}u\n#define BL_OBJECTS {objects}u\n#define BL_PORTS {}u\n\
             #define {guard}_TYPE {:#010x}u\n\n#pragma pack(push, 1)\n",
            self.name,
            ports.len(),
            self.device_type
        );
        let mut known = Vec::new();
        for port in ports {
            let mut of_type = |suffix: &str, of: &LayoutDescription, size: u8| {
                let name = identifier(&port.contract) + suffix;
                // C has no struct without members.
                if size > 0 && !known.contains(&name) {
                    let _ =
                        writeln!(text, "{};", CType(of.types()).declared("typedef ", 0, &name, 0));
                    known.push(name);
                }
            };
            of_type("", &port.message, port.size);
            of_type("_reply", &port.reply, port.reply_size);
        }
        text.push_str("#pragma pack(pop)\n\n/* Indices, for bl_publish and bl_call. */\nenum {\n");
        for port in ports {
            let _ = writeln!(text, "    {},", port.name());
        }
        text.push_str("    PORT_COUNT\n};\n\n/* Records of bl_ports, in this order. */\n");
        for port in ports {
            let _ = writeln!(
                text,
                "#define {}(data_) {{.object = {}, .id = BL_{} + {}, .data = (data_), \\\n    \
                 .size = {}, .reply = {}, .fingerprint = {:#010x}u}}",
                port.name(),
                port.object,
                port.kind(),
                port.number,
                port.size,
                port.reply_size,
                port.fingerprint
            );
        }
        text.push_str("\n#endif\n");
        text
    }

    /// An example of the firmware, for the boards in `core/lite/c/boards`: it compiles, takes part,
    /// and does nothing yet.
    pub fn firmware(&self) -> String {
        let device = identifier(&self.name);
        let mut text = format!(
            "/* A firmware of the device `{}`. Compile it with -DBL_CONFIG='\"{device}.h\"',\n \
             * blastema_lite.c and one of the boards. */\n#include \"board.h\"\n\n",
            self.name
        );
        let data = |port: &DescribedPort| port.name().to_lowercase();
        let has_data = |port: &&DescribedPort| port.direction != PortKind::Call && port.size > 0;
        for port in self.ports.iter().filter(has_data) {
            let _ = writeln!(text, "static {} {};", identifier(&port.contract), data(port));
        }
        for object in 1..=self.objects() {
            let _ = write!(
                text,
                "\nstatic uint8_t work{object}(uint8_t why) {{\n    (void)why;\n    \
                 /* What it does at its rate. */\n"
            );
            let outs = self.ports.iter().filter(|port| port.direction == PortKind::Out);
            for port in outs.filter(|port| port.object == object) {
                let _ = writeln!(text, "    bl_publish({});", port.name());
            }
            let _ = write!(
                text,
                "    return 0; /* or the code of a fault, 1 to 239 */\n}}\n\
                 static uint8_t rest{object}(uint8_t why) {{\n    (void)why;\n    \
                 /* Safe outputs, also when the node is silent. */\n    return 0;\n}}\n"
            );
        }
        let guard = device.to_uppercase();
        let _ = write!(
            text,
            "\nconst uint32_t bl_device_type BL_ROM = {guard}_TYPE;\n\
             const bl_object bl_objects[BL_OBJECTS] BL_ROM = {{\n"
        );
        for object in 1..=self.objects() {
            let _ = writeln!(
                text,
                "    {{.hook = {{[BL_ON_EXECUTE] = work{object},\n              \
                 [BL_ON_DEACTIVATED] = rest{object}, [BL_ON_ABORTING] = rest{object}}}}},"
            );
        }
        text.push_str("};\nconst bl_port bl_ports[BL_PORTS] BL_ROM = {\n");
        for port in &self.ports {
            let at = if has_data(&port) { format!("&{}", data(port)) } else { "0".to_owned() };
            let _ = writeln!(text, "    {}({at}),", port.name());
        }
        text.push_str(concat!(
            "};\n\nuint8_t bl_call(uint8_t port, uint8_t *data) {\n",
            "    (void)port, (void)data;\n",
            "    return 1; /* refused; 0 when the result is in data */\n}\n",
            "uint8_t bl_text(uint8_t object, uint8_t code, uint8_t *text, uint8_t room) {\n",
            "    (void)object, (void)code, (void)text, (void)room;\n    return 0;\n}\n\n",
            "int main(int count, char **arguments) { board_run(count, arguments); }\n"
        ));
        text
    }
}

fn identifier(name: &str) -> String {
    let plain = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '_' };
    let name: String = name.chars().map(plain).collect();
    match name.chars().next() {
        Some('0'..='9') | None => format!("_{name}"),
        _ if KEYWORDS.contains(&name.as_str()) => name + "_",
        _ => name,
    }
}

/// A table of types, for C.
struct CType<'a>(&'a [Shape<u32>]);

impl CType<'_> {
    /// The type; one nested so deep that it may contain itself is shown as a byte.
    fn shape(&self, of: u32, depth: usize) -> &Shape<u32> {
        const BYTE: &Shape<u32> = &Shape::Leaf(Primitive::U8);
        if depth > DEPTH_MAX { BYTE } else { &self.0[of as usize] }
    }

    /// The declaration of a member, or a type, of this name; without the semicolon.
    fn declared(&self, before: &str, of: u32, name: &str, depth: usize) -> String {
        let indent = "    ".repeat(depth);
        let plain = |of: &str| format!("{indent}{before}{of} {name}");
        let block = |members: &str| plain(&format!("struct {{\n{members}{indent}}}"));
        match self.shape(of, depth) {
            Shape::Leaf(leaf) => plain(leaf_type(*leaf)),
            Shape::Array(of, length) => {
                self.declared(before, *of, &format!("{name}[{length}]"), depth)
            }
            Shape::AtMost(of, bound) => {
                let item = format!("item[{bound}]");
                let items = match self.shape(*of, depth) {
                    Shape::Sequence(of) | Shape::Set(of) => {
                        self.declared("", *of, &item, depth + 1)
                    }
                    _ => format!("{indent}    uint8_t {item}"),
                };
                block(&format!("{indent}    uint8_t len;\n{items};\n"))
            }
            Shape::Optional(of) => {
                let value = self.declared("", *of, "value", depth + 1);
                block(&format!("{indent}    uint8_t some;\n{value};\n"))
            }
            Shape::Tuple(parts) => {
                let members = parts
                    .iter()
                    .enumerate()
                    .map(|(at, of)| self.declared("", *of, &format!("_{at}"), depth + 1) + ";\n");
                block(&members.collect::<String>())
            }
            Shape::Struct(_, fields) => block(&self.members(fields, depth)),
            Shape::Enum(_, variants) => {
                let numbers = variants.iter().enumerate();
                let numbers = numbers.map(|(at, variant)| format!("{at} {}", variant.name));
                let listed = format!("/* {} */", numbers.collect::<Vec<_>>().join(", "));
                let with_fields = variants.iter().filter(|it| !it.fields.as_slice().is_empty());
                let cases = with_fields.map(|variant| {
                    let members = self.members(&variant.fields, depth + 2);
                    let name = identifier(&variant.name);
                    format!("{indent}        struct {{\n{members}{indent}        }} {name};\n")
                });
                match cases.collect::<String>().as_str() {
                    "" => plain("uint8_t") + " " + &listed,
                    cases => block(&format!(
                        "{indent}    uint8_t tag; {listed}\n\
                         {indent}    union {{\n{cases}{indent}    }} as;\n"
                    )),
                }
            }
            // They have no packed form, and no port has them.
            _ => plain("uint8_t"),
        }
    }

    fn members(&self, fields: &Fields<u32>, depth: usize) -> String {
        let mut text = String::new();
        for field in fields.as_slice() {
            let digit = field.name.starts_with(|c: char| c.is_ascii_digit());
            let name = if digit { format!("_{}", field.name) } else { identifier(&field.name) };
            let _ = write!(text, "{};", self.declared("", field.of, &name, depth + 1));
            let notes: Vec<_> = field.unit.iter().chain(&field.frame).map(|note| &**note).collect();
            match notes.is_empty() {
                true => text.push('\n'),
                false => drop(writeln!(text, " /* {} */", notes.join(", in frame "))),
            }
        }
        text
    }
}

fn leaf_type(leaf: Primitive) -> &'static str {
    match leaf {
        Primitive::U16 => "uint16_t",
        Primitive::U32 | Primitive::Char => "uint32_t",
        Primitive::U64 => "uint64_t",
        Primitive::I8 => "int8_t",
        Primitive::I16 => "int16_t",
        Primitive::I32 => "int32_t",
        Primitive::I64 => "int64_t",
        Primitive::F32 => "float",
        Primitive::F64 => "bl_f64",
        Primitive::U128 | Primitive::I128 => "struct { uint8_t bytes[16]; }",
        Primitive::Duration => "struct { uint64_t s; uint32_t ns; }",
        _ => "uint8_t",
    }
}
